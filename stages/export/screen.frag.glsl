#version 300 es
// Lays the accumulated splats over the background.
precision highp float;

uniform sampler2D u_splats;
uniform vec3 u_background;
out vec4 pixel;

void main() {
  vec4 splats = texelFetch(u_splats, ivec2(gl_FragCoord.xy), 0);
  pixel = vec4(splats.rgb + (1.0 - splats.a) * u_background, 1.0);
}
