#version 300 es
// Blended front to back: the target holds premultiplied colour and 1 - transmittance. As in
// stages/splatting/raster_kernels.py, alpha is at most 0.999 and dropped below 1/255.
precision highp float;

in vec2 factored;
flat in vec4 colour;
out vec4 blended;

void main() {
  float exponent = dot(factored, factored), alpha = colour.a * exp(-exponent);
  if (alpha < 1.0 / 255.0) discard;
  alpha = min(alpha, 0.999);
  blended = vec4(colour.rgb * alpha, alpha);
}
