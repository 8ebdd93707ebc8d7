#version 300 es
// From premultiplied colour to the screen: background, exposure; or inverse depth as a colour.
precision highp float;
precision highp sampler2D;

in vec2 place;
uniform sampler2D image;
uniform vec3 background, gain;
uniform vec2 range;  // inverse depths that are drawn darkest and brightest
uniform int mode;
out vec4 shown;

// Polynomial approximation of matplotlib's inferno, dark to bright, which also reads in grey.
vec3 inferno(float t) {
  const vec3 c0 = vec3(0.0002, 0.0017, -0.0194), c1 = vec3(0.1065, 0.5640, 3.9327);
  const vec3 c2 = vec3(11.6025, -3.9729, -15.9424), c3 = vec3(-41.7040, 17.4364, 44.3541);
  const vec3 c4 = vec3(77.1629, -33.4024, -81.8073);
  const vec3 c5 = vec3(-71.3194, 32.6261, 73.2095), c6 = vec3(25.1311, -12.2427, -23.0703);
  return c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6)))));
}

void main() {
  vec4 sum = texture(image, place);
  if (mode == 1) {
    float share = clamp((sum.r / max(sum.a, 1e-3) - range.x) / (range.y - range.x), 0.0, 1.0);
    shown = vec4(clamp(inferno(share), 0.0, 1.0) * smoothstep(0.0, 0.3, sum.a), 1);
  } else {
    vec3 behind = mode == 2 ? vec3(0) : background;
    shown = vec4((sum.rgb + (1.0 - sum.a) * behind) * (mode == 2 ? vec3(1) : gain), 1);
  }
}
