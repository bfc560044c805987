#version 300 es
// Lays the accumulated splats over the background, and the mesh over both.
precision highp float;

uniform sampler2D u_splats;
uniform sampler2D u_mesh;
uniform float u_mesh_share;       // how much of the mesh is mixed in
uniform ivec2 u_offset;           // of the pane in the canvas
uniform vec3 u_background;
out vec4 pixel;

void main() {
  ivec2 place = ivec2(gl_FragCoord.xy) - u_offset;
  vec4 splats = texelFetch(u_splats, place, 0);
  vec3 scene = splats.rgb + (1.0 - splats.a) * u_background;
  vec4 mesh = texelFetch(u_mesh, place, 0);
  pixel = vec4(mix(scene, mesh.rgb, mesh.a * u_mesh_share), 1.0);
}
