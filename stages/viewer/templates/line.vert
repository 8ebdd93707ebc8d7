#version 300 es
// Points and lines of the world in the same camera as the splats.
precision highp float;

in vec3 position;
in vec4 tint;
uniform vec3 eye, right, down, ahead;
uniform vec4 lens;
uniform vec2 size;
uniform float near, point_px;
out vec4 colour;

void main() {
  vec3 from_eye = position - eye, p = vec3(dot(right, from_eye), dot(down, from_eye), dot(ahead, from_eye));
  vec2 at = 2.0 * (lens.xy * p.xy + (lens.zw + 0.5) * p.z) / size - p.z;  // times w, which is p.z
  gl_Position = vec4(at.x, -at.y, p.z - 2.0 * near, p.z);
  gl_PointSize = point_px;
  colour = tint;
}
