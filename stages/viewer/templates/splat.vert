#version 300 es
// The parallelogram around the ellipse in which a splat's alpha is at least 1/255. In the coordinates (q, p) of its
// Cholesky factor the ellipse is a circle and the parallelogram a square.
precision highp float;

in vec4 splat_centre, splat_shape, splat_colour;
uniform vec2 size;
out vec2 factored;
flat out vec4 colour;

void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  factored = corner * splat_shape.y;
  colour = vec4(splat_colour.rgb, splat_shape.z);
  float dy = factored.y / splat_shape.x, dx = (factored.x - splat_centre.w * dy) / splat_centre.z;
  vec2 at = (splat_centre.xy + vec2(dx, dy) + 0.5) / size * 2.0 - 1.0;
  gl_Position = splat_shape.y > 0.0 ? vec4(at.x, -at.y, 0, 1) : vec4(2, 2, 2, 1);  // outside: not drawn
}
