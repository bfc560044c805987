// Draws Gaussians with WebGL2, with the conventions of stages/splatting.

/**
 * @typedef {object} Pose A pinhole camera, OpenCV axes (x right, y down, z forward).
 * @property {number[]} rotation 9 numbers, row-major, of cam_from_world
 * @property {number[]} translation 3 numbers
 * @property {number} fx
 * @property {number} fy
 * @property {number} cx
 * @property {number} cy
 * @property {number} width image that the intrinsics refer to, in pixels
 * @property {number} height
 */

class SplatRenderer {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{count: number, sh_degree: number, texels: number, per_row: number,
   *   rasterizer: object, light: ?object}} format of the packed splats
   * @param {Splats} splats
   * @param {Record<string, string>} shaders GLSL by file name
   */
  constructor(canvas, format, splats, shaders) {
    this.canvas = canvas;
    this.format = format;
    this.contents = splats;
    this.shaders = shaders;
    this.orders = [null, null];  // of both panes
    this.#build();
  }

  #build() {
    const gl = this.canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: false, powerPreference: "high-performance",
    });
    if (!gl) throw new Error("This browser or device offers no WebGL2.");
    this.gl = gl;
    // Half floats keep faint layers that 8 bits would round away.
    this.halfFloat = Boolean(gl.getExtension("EXT_color_buffer_float")
      ?? gl.getExtension("EXT_color_buffer_half_float"));
    const { texels, per_row: perRow, sh_degree: degree, rasterizer: r } = this.format;
    const defines = {
      TEXELS: texels, PER_ROW: perRow, SH_DEGREE: degree, LIT: this.format.light ? 1 : 0,
      LOW_PASS: r.low_pass.toFixed(6),
      ALPHA_MIN: r.alpha_min.toFixed(9), ALPHA_MAX: r.alpha_max.toFixed(6),
    };
    this.splatProgram = this.#program("splat.vert.glsl", "splat.frag.glsl", defines);
    this.screenProgram = this.#program("screen.vert.glsl", "screen.frag.glsl", {});
    this.#upload();
    this.panes = [0, 1].map(() => this.#pane());
    this.noVertices = gl.createVertexArray();
    this.target = null;
    const { mesh } = this.contents;
    this.mesh = mesh
      && new MeshLayer(gl, this.#program("mesh.vert.glsl", "mesh.frag.glsl", {}), mesh);
    this.orders.forEach((order, pane) => order && this.setOrder(order, pane));
  }

  /** The order of the splats in one pane, as the vertex shader reads it. */
  #pane() {
    const gl = this.gl;
    const buffer = gl.createBuffer();
    const vertices = gl.createVertexArray();
    gl.bindVertexArray(vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    const slot = gl.getAttribLocation(this.splatProgram.handle, "a_splat");
    gl.enableVertexAttribArray(slot);
    gl.vertexAttribIPointer(slot, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(slot, 1);
    gl.bindVertexArray(null);
    return { buffer, vertices };
  }

  /** After a lost context: everything on the graphics card has to be made again. */
  restore() {
    this.#build();
  }

  #program(vertexName, fragmentName, defines) {
    const gl = this.gl;
    const head = Object.entries(defines).map(([key, value]) => `#define ${key} ${value}\n`).join("");
    const handle = gl.createProgram();
    for (const [kind, name] of [[gl.VERTEX_SHADER, vertexName], [gl.FRAGMENT_SHADER, fragmentName]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, this.shaders[name].replace("\n", `\n${head}`));
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error(`The graphics driver refused ${name}: ${gl.getShaderInfoLog(shader)}`);
      }
      gl.attachShader(handle, shader);
    }
    gl.linkProgram(handle);
    if (!gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`The graphics driver refused the program: ${gl.getProgramInfoLog(handle)}`);
    }
    const uniforms = {};
    const number = gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS) ?? 0;
    for (let k = 0; k < number; k++) {
      const { name } = gl.getActiveUniform(handle, k);
      uniforms[name] = gl.getUniformLocation(handle, name);
    }
    return { handle, uniforms };
  }

  #upload() {
    const gl = this.gl;
    const { count, texels, per_row: perRow } = this.format;
    const width = perRow * texels;
    const height = Math.max(1, Math.ceil(count / perRow));
    if (Math.max(width, height) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error(`The scene is too large for this device (${count} Gaussians).`);
    }
    const padded = new Uint32Array(width * height * 4);
    padded.set(this.contents.packed);
    this.splats = this.#texture();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, width, height, 0, gl.RGBA_INTEGER,
      gl.UNSIGNED_INT, padded);
    const flags = new Uint8Array(perRow * height);
    flags.set(this.contents.flags);
    this.flags = this.#texture();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8UI, perRow, height, 0, gl.RED_INTEGER, gl.UNSIGNED_BYTE,
      flags);
  }

  #texture() {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  #resizeTarget(width, height) {
    if (this.target?.width === width && this.target?.height === height) return;
    const gl = this.gl;
    if (this.target) {
      gl.deleteTexture(this.target.texture);
      gl.deleteFramebuffer(this.target.framebuffer);
    }
    const texture = this.#texture();
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.halfFloat ? gl.RGBA16F : gl.RGBA8, width, height);
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && this.halfFloat
        && !gl.isContextLost()) {
      this.halfFloat = false;
      this.target = { texture, framebuffer, width: 0, height: 0 };
      this.#resizeTarget(width, height);
      return;
    }
    this.target = { texture, framebuffer, width, height };
  }

  /** @param {Uint32Array} order splat indices, farthest first @param {number} pane 0 or 1 */
  setOrder(order, pane = 0) {
    const gl = this.gl;
    this.orders[pane] = order;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.panes[pane].buffer);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
  }

  /** Nearer or farther than the photographs, the light must neither glare nor go out. */
  #exposure(eye) {
    const { globals, centre, distances: [nearest, farthest] } = this.format.light;
    const distance = Math.hypot(...eye.map((value, axis) => value - centre[axis]));
    return (distance / Math.min(Math.max(distance, nearest), farthest)) ** globals[1];
  }

  /** The background all over the canvas: panes may leave a part of it. @param {number[]} background */
  clear(background) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /**
   * Draw a pane of the canvas: as many pixels as the pose has, from the pixel `left` on.
   * @param {Pose} pose @param {number[]} background rgb in 0..1
   * @param {{jaw: number, cut: number[], support: boolean, mesh: boolean}} shown
   * @param {{pane: number, left: number, from: number, to: number, share: number}} where only the
   *   pane's columns `from` to `to` are drawn, and mixed by `share` into what is there
   */
  draw(pose, background, shown, { pane = 0, left = 0, from = 0, to = pose.width, share = 1 } = {}) {
    const gl = this.gl;
    if (gl.isContextLost() || !this.orders[pane] || to <= from || share <= 0) return;
    const { width, height } = pose;
    this.#resizeTarget(width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(from, 0, to - from, height);
    const mesh = shown.mesh && this.mesh
      ? this.mesh.draw(pose, this.format.rasterizer.near, shown) : null;
    this.#drawSplats(pose, shown, pane);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(left, 0, width, height);
    gl.scissor(left + from, 0, to - from, height);
    gl.enable(gl.BLEND);
    gl.blendColor(0, 0, 0, share);
    gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
    gl.useProgram(this.screenProgram.handle);
    const u = this.screenProgram.uniforms;
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, mesh ?? this.target.texture);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(u.u_mesh, 1);
    gl.uniform1f(u.u_mesh_share, mesh ? 0.8 : 0);
    gl.uniform2i(u.u_offset, left, 0);
    gl.bindVertexArray(this.noVertices);
    gl.uniform3fv(u.u_background, background);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
  }

  #drawSplats(pose, shown, pane) {
    const gl = this.gl;
    const { width, height, fx, fy, cx, cy, rotation: R, translation: t } = pose;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.splatProgram.handle);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.flags);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.splats);
    gl.bindVertexArray(this.panes[pane].vertices);
    const u = this.splatProgram.uniforms;
    const { near, slope_margin: margin } = this.format.rasterizer;
    gl.uniform1i(u.u_flags, 1);
    gl.uniform1i(u.u_jaw, shown.jaw);
    gl.uniform4fv(u.u_cut, shown.cut);
    gl.uniform1i(u.u_support, shown.support ? 1 : 0);
    gl.uniformMatrix3fv(u.u_rotation, true, R);
    gl.uniform3fv(u.u_translation, t);
    gl.uniform3fv(u.u_centre, centreOf(R, t));
    gl.uniform2f(u.u_focal, fx, fy);
    gl.uniform2f(u.u_principal, cx, cy);
    gl.uniform2f(u.u_size, width, height);
    gl.uniform2f(u.u_slope_min, (-margin * width - cx) / fx, (-margin * height - cy) / fy);
    gl.uniform2f(u.u_slope_max,
      ((1 + margin) * width - cx) / fx, ((1 + margin) * height - cy) / fy);
    gl.uniform1f(u.u_near, near);
    if (this.format.light) {
      gl.uniform1fv(u["u_light[0]"] ?? u.u_light, this.format.light.globals);
      gl.uniform1f(u.u_exposure, this.#exposure(centreOf(R, t)));
    }
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.orders[pane].length);
  }
}
