#version 300 es
precision highp float;

in vec2 v_offset;
flat in vec4 v_colour;
out vec4 premultiplied;

void main() {
  float alpha = min(ALPHA_MAX, v_colour.a * exp(-0.5 * dot(v_offset, v_offset)));
  if (alpha < ALPHA_MIN) discard;
  premultiplied = vec4(v_colour.rgb * alpha, alpha);
}
