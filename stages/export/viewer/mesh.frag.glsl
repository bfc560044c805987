#version 300 es
// Clay, lit from the eye.
precision highp float;

uniform vec3 u_centre;            // projection centre in the world
uniform vec4 u_cut;               // what lies beyond this plane is cut away
uniform int u_jaw;                // 0: all, 1: upper, 2: lower
in vec3 v_world;
in vec3 v_normal;
flat in float v_jaw;
out vec4 pixel;

void main() {
  if (dot(u_cut.xyz, v_world) > u_cut.w) discard;
  if (u_jaw > 0 && int(v_jaw + 0.5) != u_jaw) discard;
  float facing = abs(dot(normalize(v_normal), normalize(u_centre - v_world)));
  pixel = vec4(vec3(0.72, 0.80, 0.84) * (0.2 + 0.8 * facing), 1.0);
}
