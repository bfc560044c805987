#version 300 es
// The triangle mesh that can be laid over the scene.
precision highp float;

uniform mat3 u_rotation;          // cam_from_world
uniform vec3 u_translation;
uniform vec2 u_focal;             // pixels
uniform vec2 u_principal;
uniform vec2 u_size;
uniform float u_near;

in vec3 a_position;
in vec3 a_normal;
in float a_jaw;
out vec3 v_world;
out vec3 v_normal;
flat out float v_jaw;        // between jaws it means nothing

void main() {
  vec3 p = u_rotation * a_position + u_translation;
  float far = 4000.0 * u_near;
  float depth = ((far + u_near) * p.z - 2.0 * far * u_near) / (far - u_near);
  vec2 pixel = u_focal * p.xy + u_principal * p.z;  // times z
  gl_Position = vec4(2.0 * pixel.x / u_size.x - p.z, p.z - 2.0 * pixel.y / u_size.y, depth, p.z);
  v_world = a_position;
  v_normal = a_normal;
  v_jaw = a_jaw;
}
