// Draws the triangle mesh into a picture of its own, which the screen shader lays over the scene.

/**
 * @param {Float32Array} vertices three numbers each @param {Uint16Array} faces three corners each
 * @returns {Float32Array} the vertices' normals, those of their triangles by area; of any length
 */
function vertexNormals(vertices, faces) {
  const normals = new Float32Array(vertices.length);
  const point = (corner) => vertices.subarray(3 * corner, 3 * corner + 3);
  for (let k = 0; k < faces.length; k += 3) {
    const corners = faces.subarray(k, k + 3);
    const [a, b, c] = [...corners].map(point);
    const normal = cross(minus(b, a), minus(c, a));
    for (const corner of corners) {
      for (let axis = 0; axis < 3; axis++) normals[3 * corner + axis] += normal[axis];
    }
  }
  return normals;
}

class MeshLayer {
  /** @param {WebGL2RenderingContext} gl @param {object} program @param {object} mesh see `Splats` */
  constructor(gl, program, mesh) {
    this.gl = gl;
    this.program = program;
    this.count = mesh.faces.length;
    this.target = null;
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    this.#attribute("a_position", mesh.vertices, 3, gl.FLOAT);
    this.#attribute("a_normal", vertexNormals(mesh.vertices, mesh.faces), 3, gl.FLOAT);
    this.#attribute("a_jaw", mesh.jaws, 1, gl.UNSIGNED_BYTE);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  #attribute(name, values, size, type) {
    const { gl } = this;
    const slot = gl.getAttribLocation(this.program.handle, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(slot);
    gl.vertexAttribPointer(slot, size, type, false, 0, 0);
  }

  #resize(width, height) {
    if (this.target?.width === width && this.target?.height === height) return;
    const { gl } = this;
    if (this.target) {
      gl.deleteTexture(this.target.texture);
      gl.deleteRenderbuffer(this.target.depth);
      gl.deleteFramebuffer(this.target.framebuffer);
    }
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    const depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    this.target = { texture, depth, framebuffer, width, height };
  }

  /** @returns {WebGLTexture} the mesh as the pose sees it, transparent where there is none */
  draw(pose, near, { cut, jaw }) {
    const { gl } = this;
    this.#resize(pose.width, pose.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, pose.width, pose.height);
    gl.clearColor(0, 0, 0, 0);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.program.handle);
    gl.bindVertexArray(this.vertices);
    const u = this.program.uniforms;
    gl.uniformMatrix3fv(u.u_rotation, true, pose.rotation);
    gl.uniform3fv(u.u_translation, pose.translation);
    gl.uniform3fv(u.u_centre, centreOf(pose.rotation, pose.translation));
    gl.uniform2f(u.u_focal, pose.fx, pose.fy);
    gl.uniform2f(u.u_principal, pose.cx, pose.cy);
    gl.uniform2f(u.u_size, pose.width, pose.height);
    gl.uniform1f(u.u_near, near);
    gl.uniform4fv(u.u_cut, cut);
    gl.uniform1i(u.u_jaw, jaw);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_SHORT, 0);
    gl.disable(gl.DEPTH_TEST);
    return this.target.texture;
  }
}
