#version 300 es
// Moves one Gaussian to the present time and projects it: the pipeline's skinning (stages/deformation/lbs.py),
// spherical harmonics (stages/splatting/sh.py) and EWA projection (stages/splatting/projection_kernels.py). One vertex
// is one Gaussian, in drawing order; transform feedback stores the splats for splat.vert.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

in uint gaussian;

uniform sampler2D means, quats, shapes, sh_dc, sh_rest, weights, lives, drifts, motions, points, shade;
uniform usampler2D index, instances;
uniform int n_lit, n_static, pairs, sh_degree, mode;  // n_lit: static ones in steady light
uniform vec3 sh_steps[15];            // what +-1 in sh_rest stands for
uniform vec3 eye, right, down, ahead;  // centre of the camera, rows of its rotation
uniform vec4 lens;                     // fx fy cx cy in px, pixel centres at integers
uniform vec2 size;
uniform float blur, near, time;        // time in frames
uniform float extinction;              // of the fog: 0 in clear air
uniform vec3 airlight;                 // linear

out vec4 splat_centre;  // x y f0 f1
out vec4 splat_shape;   // f2, reach in standard deviations times sqrt(1/2), opacity, depth
out vec4 splat_colour;

const float MIN_ALPHA = 1.0 / 255.0, MARGIN = 0.15;
const float C0 = 0.28209479177387814, C1 = 0.4886025119029199;
const float C2[5] = float[](1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792,
                            0.5462742152960396);
const float C3[7] = float[](-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
                            -0.4570457994644658, 1.445305721320277, -0.5900435899266435);

ivec2 at(int i) { return ivec2(i & 1023, i >> 10); }

vec3 turned(vec4 q, vec3 v) {  // q is wxyz
  vec3 t = 2.0 * cross(q.yzw, v);
  return v + q.x * t + cross(q.yzw, t);
}

vec4 product(vec4 a, vec4 b) {
  return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

mat3 rotation(vec4 q) { return mat3(turned(q, vec3(1, 0, 0)), turned(q, vec3(0, 1, 0)), turned(q, vec3(0, 0, 1))); }

// Linear blend skinning: mean and quaternion become those of this moment. Returns the offset of the colour.
vec3 skin(int d, inout vec3 mean, inout vec4 quat) {
  vec3 moved = vec3(0), offset = vec3(0);
  vec4 blended = vec4(0), heaviest;
  for (int k = 0; k < pairs; k++) {
    int p = int(texelFetch(index, at(d * pairs + k), 0).r);
    float w = texelFetch(weights, at(d * pairs + k), 0).r;
    vec4 q = texelFetch(motions, at(3 * p), 0);
    vec3 point = texelFetch(points, at(p), 0).xyz;
    if (k == 0) heaviest = q;
    moved += w * (turned(q, mean - point) + point + texelFetch(motions, at(3 * p + 1), 0).xyz);
    offset += w * texelFetch(motions, at(3 * p + 2), 0).xyz;
    blended += w * (dot(q, heaviest) < 0.0 ? -q : q);
  }
  mean = moved;
  quat = product(normalize(blended), quat);
  return offset;
}

vec3 rest(int i, int k) {
  int count = (sh_degree + 1) * (sh_degree + 1) - 1;
  return texelFetch(sh_rest, at(i * count + k), 0).rgb * sh_steps[k];
}

vec3 harmonics(int i, vec3 constant, vec3 direction) {
  vec3 c = 0.5 + C0 * constant;
  float x = direction.x, y = direction.y, z = direction.z, xx = x * x, yy = y * y, zz = z * z;
  if (sh_degree > 0) c += C1 * (-y * rest(i, 0) + z * rest(i, 1) - x * rest(i, 2));
  if (sh_degree > 1) {
    c += C2[0] * x * y * rest(i, 3) + C2[1] * y * z * rest(i, 4) + C2[2] * (2.0 * zz - xx - yy) * rest(i, 5);
    c += C2[3] * x * z * rest(i, 6) + C2[4] * (xx - yy) * rest(i, 7);
  }
  if (sh_degree > 2) {
    c += C3[0] * y * (3.0 * xx - yy) * rest(i, 8) + C3[1] * x * y * z * rest(i, 9);
    c += C3[2] * y * (4.0 * zz - xx - yy) * rest(i, 10) + C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * rest(i, 11);
    c += C3[4] * x * (4.0 * zz - xx - yy) * rest(i, 12) + C3[5] * z * (xx - yy) * rest(i, 13);
    c += C3[6] * x * (xx - 3.0 * yy) * rest(i, 14);
  }
  return max(c, 0.0);
}

// What shows through the fog (stages/splatting/atmosphere.py).
vec3 veiled(vec3 colour, float distance) {
  if (extinction <= 0.0) return colour;
  vec3 linear = pow(max(colour, vec3(0.00534)), vec3(2.2));
  return pow(max(mix(airlight, linear, exp(-extinction * distance)), vec3(1e-5)), vec3(1.0 / 2.2));
}

// A hue for each instance, neighbours far apart; grey where nothing moves.
vec3 instance_colour(int i, vec3 colour) {
  float grey = dot(colour, vec3(0.3, 0.6, 0.1));
  if (i < n_static) return vec3(0.5 * grey);
  int number = int(texelFetch(instances, at(i - n_static), 0).r);
  if (number == 0) return vec3(0.3 + 0.7 * grey);
  vec3 hue = 0.5 + 0.5 * cos(6.2831853 * (0.61803399 * float(number) + vec3(0, 0.33, 0.67)));
  return mix(vec3(grey), hue, 0.7);
}

void main() {
  int i = int(gaussian);
  vec3 mean = texelFetch(means, at(i), 0).xyz, constant = texelFetch(sh_dc, at(i), 0).rgb;
  vec4 quat = normalize(texelFetch(quats, at(i), 0)), shape = texelFetch(shapes, at(i), 0);
  if (i >= n_static) {
    vec2 life = texelFetch(lives, at(i - n_static), 0).xy;
    float away = (time - life.x) * life.y;
    shape.w *= exp(-away * away);
    mean += away * texelFetch(drifts, at(i - n_static), 0).xyz;
    constant += skin(i - n_static, mean, quat);
  } else if (i >= n_lit) {
    constant += texelFetch(shade, at(i - n_lit), 0).rgb;
  }

  vec3 from_eye = mean - eye, p = vec3(dot(right, from_eye), dot(down, from_eye), dot(ahead, from_eye));
  splat_shape = vec4(0);
  splat_centre = splat_colour = vec4(0);
  gl_Position = vec4(0);
  if (p.z <= near) return;
  vec2 low = (-0.5 - MARGIN * size - lens.zw) / lens.xy, high = (size - 0.5 + MARGIN * size - lens.zw) / lens.xy;
  vec2 slope = clamp(p.xy / p.z, low, high), gain = lens.xy / p.z;
  mat3 axes = rotation(quat);
  vec3 u = ((right - slope.x * ahead) * gain.x) * axes * exp(shape.xyz);
  vec3 v = ((down - slope.y * ahead) * gain.y) * axes * exp(shape.xyz);
  vec3 normal = cross(u, v);
  float b = dot(u, v), c = dot(v, v) + blur, det = dot(normal, normal) + blur * (dot(u, u) + dot(v, v)) + blur * blur;
  float f0 = sqrt(c / (2.0 * det)), limit = log(max(shape.w, 1e-12) / MIN_ALPHA);
  splat_centre = vec4(lens.xy * p.xy / p.z + lens.zw, f0, -b / c * f0);
  splat_shape = vec4(inversesqrt(2.0 * c), sqrt(max(limit, 0.0)), shape.w, p.z);
  vec3 colour = veiled(harmonics(i, constant, normalize(from_eye)), length(from_eye));
  splat_colour = vec4(mode == 1 ? vec3(1.0 / p.z) : mode == 2 ? instance_colour(i, colour) : colour, 1);
}
