#version 300 es
// The parallelogram around the ellipse in which a splat's alpha is at least 1/255. In the coordinates (q, p) of its
// Cholesky factor the ellipse is a circle and the parallelogram a square.
precision highp float;

uniform highp sampler2D splats;  // three texels each, as project.vert left them: centre, shape, colour
uniform vec2 size;
out vec2 factored;
flat out vec4 colour;

ivec2 at(int i) { return ivec2(i & 1023, i >> 10); }

void main() {
  int first = 3 * (gl_VertexID >> 2);
  vec4 splat_centre = texelFetch(splats, at(first), 0), splat_shape = texelFetch(splats, at(first + 1), 0);
  vec4 splat_colour = texelFetch(splats, at(first + 2), 0);
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  factored = corner * splat_shape.y;
  colour = vec4(splat_colour.rgb, splat_shape.z);
  float dy = factored.y / splat_shape.x, dx = (factored.x - splat_centre.w * dy) / splat_centre.z;
  vec2 place = (splat_centre.xy + vec2(dx, dy) + 0.5) / size * 2.0 - 1.0;
  gl_Position = splat_shape.y > 0.0 ? vec4(place.x, -place.y, 0, 1) : vec4(2, 2, 2, 1);  // outside: not drawn
}
