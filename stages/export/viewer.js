// The page: reads the embedded scene, wires the buttons, keys and fingers to the camera.
//
// For tests and for embedding, `window.dentalsplat` offers
//   ready                  a promise, fulfilled once the first picture has been drawn
//   views                  the poses of the photographs
//   setCamera(m, fx, fy, cx, cy, width, height)
//                          exact camera: m = cam_from_world (12 or 16 numbers, row-major, OpenCV
//                          axes), and the canvas gets exactly that many pixels
//   setBackground([r, g, b])   in 0..1
//   render()               sort and draw now, not at the next frame
//   pixels()               the drawn picture, RGBA bytes, top row first
// In the address, `#view=3` opens at the third photograph, `&bare` hides the controls, `&still` turns
// moving transitions off. Errors are kept in <html data-errors>, progress in <html data-state>.

const byId = (id) => document.getElementById(id);
const root = document.documentElement;
root.dataset.state = "loading";

function report(error) {
  root.dataset.errors = `${root.dataset.errors ?? ""}${error?.message ?? error}\n`;
}

function fail(error) {
  report(error);
  root.dataset.state = "failed";
  byId("reason").textContent = `${error?.message ?? error} Try a recent Chrome, Edge, Firefox or `
    + "Safari with graphics acceleration switched on. splats.ply, from the same export, opens in "
    + "any viewer for 3D Gaussians.";
  byId("message").hidden = false;
  byId("bar").hidden = true;
}

addEventListener("error", (event) => report(event.error ?? event.message));
addEventListener("unhandledrejection", (event) => report(event.reason));

function unpacked(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  return new Uint32Array(bytes.buffer);
}

const BACKGROUNDS = [[0, 0, 0], [0.5, 0.5, 0.5], [1, 1, 1]];

class Viewer {
  constructor(scene, packed) {
    this.scene = scene;
    this.canvas = byId("canvas");
    this.camera = new OrbitCamera(scene.orbiting);
    this.renderer = new SplatRenderer(this.canvas, scene.format, packed, scene.shaders);
    this.positions = this.#positions(packed);
    this.sorter = new Sorter(this.positions, (order) => {
      this.renderer.setOrder(order);
      this.wake(false);
    });
    this.background = 0;
    const own = scene.background;
    this.backgrounds = own.some((value) => value > 0) ? [own, ...BACKGROUNDS] : BACKGROUNDS;
    this.backdrop = this.backgrounds[0];
    this.exact = null;      // a pose set through the hook
    this.view = -1;         // the photograph whose camera this is, or -1
    this.motion = null;     // a running transition
    this.turning = null;    // the running automatic turn
    this.detail = 1;        // share of the screen's resolution while moving
    this.lastFrame = 0;
    this.moved = false;
    this.asleep = true;
  }

  #positions(packed) {
    const stride = 4 * this.scene.format.texels;
    const floats = new Float32Array(packed.buffer);
    const positions = new Float32Array(3 * this.scene.format.count);
    for (let k = 0; k < this.scene.format.count; k++) {
      positions.set(floats.subarray(k * stride, k * stride + 3), 3 * k);
    }
    return positions;
  }

  /** Draw at the next frame; `moving` if the camera changed and so does the depth order. */
  wake(moving = true) {
    this.moved ||= moving;
    if (!this.asleep) return;
    this.asleep = false;
    requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    this.asleep = true;
    const elapsed = now - this.lastFrame;
    this.lastFrame = now;
    const moving = this.#advance(now) || this.held;
    this.#adapt(moving, elapsed);
    const pose = this.#currentPose();
    if (this.moved) {
      this.moved = false;
      this.sorter.request(depthAxis(pose));
      this.settle && clearTimeout(this.settle);
      this.settle = setTimeout(() => { this.detail < 1 && this.wake(false); }, 250);
    }
    this.renderer.draw(pose, this.backdrop);
    this.#layPhoto(pose);
    if (this.motion || this.turning) this.wake(true);
  }

  /** On slow devices, move at a lower resolution and come to rest at the full one. */
  #adapt(moving, elapsed) {
    if (!moving || elapsed > 1000) {
      this.shown = 1;
      return;
    }
    if (elapsed > 45) this.detail = Math.max(0.4, this.detail * 0.85);
    if (elapsed < 20) this.detail = Math.min(1, this.detail * 1.03);
    this.shown = this.detail;
  }

  #advance(now) {
    if (this.motion) {
      const share = clamp((now - this.motion.start) / this.motion.length, 0, 1);
      this.camera.blend(this.motion.from, this.motion.to, share * share * (3 - 2 * share));
      if (share === 1) {
        const { arrive } = this.motion;
        this.motion = null;
        arrive?.();
      }
      return true;
    }
    if (this.turning) {
      const phase = (now - this.turning.start) / this.turning.period * 2 * Math.PI;
      const { middle, reach, first } = this.turning;
      const goal = middle + reach * Math.sin(first + phase);
      this.camera.orbit(goal - this.camera.angles().azimuth, 0);
      return true;
    }
    return false;
  }

  #currentPose() {
    if (this.exact) {
      this.canvas.width = this.exact.width;
      this.canvas.height = this.exact.height;
      return this.exact;
    }
    const ratio = Math.min(devicePixelRatio || 1, 2) * (this.shown ?? 1);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    const strip = Math.min(byId("bar").offsetHeight / this.canvas.clientHeight, 0.35);
    return this.camera.fitted(width, height, strip * height);
  }

  #layPhoto(pose) {
    const photo = byId("photo");
    const share = this.view >= 0 && !this.motion ? Number(byId("opacity").value) / 100 : 0;
    photo.style.opacity = share;
    if (!pose.frame || share === 0) return;
    const scale = this.canvas.clientWidth / pose.width;
    for (const side of ["left", "top", "width", "height"]) {
      photo.style[side] = `${pose.frame[side] * scale}px`;
    }
  }

  /** Sort and draw at once, as things stand at this moment, at full resolution. */
  render() {
    this.#advance(performance.now());
    this.shown = 1;
    const pose = this.#currentPose();
    this.renderer.setOrder(backToFront(this.positions, depthAxis(pose)));
    this.renderer.draw(pose, this.backdrop);
    this.#layPhoto(pose);
  }

  /** The user moved the camera: it is no longer that of a photograph. */
  leave() {
    this.motion = null;
    this.exact = null;
    if (this.view >= 0) {
      this.view = -1;
      byId("opacity").value = 0;
      this.#announce();
    }
    this.wake();
  }

  goTo(index, { still = false } = {}) {
    const pose = this.scene.views[index];
    if (!pose) return;
    this.stopTurning();
    this.exact = null;
    const from = this.camera.snapshot();
    this.camera.place(pose);
    const to = this.camera.snapshot();
    const arrive = () => this.camera.place(pose);  // free of rounding
    this.view = index;
    if (pose.photo) byId("photo").src = pose.photo;
    this.#announce();
    if (still || this.still || matchMedia("(prefers-reduced-motion: reduce)").matches) {
      arrive();
    } else {
      this.camera.blend(from, to, 0);
      this.motion = { from, to, arrive, start: performance.now(), length: 600 };
    }
    this.wake();
  }

  #announce() {
    byId("label").textContent = this.view >= 0 ? `View ${this.view + 1}` : "";
    for (const [index, button] of [...byId("views").children].entries()) {
      button.setAttribute("aria-pressed", index === this.view);
      if (index === this.view) button.scrollIntoView?.({ block: "nearest", inline: "nearest" });
    }
  }

  nearestView() {
    const towards = this.camera.rotation.slice(6, 9);
    const likeness = this.scene.views.map((view) => dot(view.rotation.slice(6, 9), towards));
    return likeness.indexOf(Math.max(...likeness));
  }

  startTurning() {
    this.leave();
    const range = this.scene.orbiting.turn;
    const { azimuth } = this.camera.angles();
    const middle = (range[0] + range[1]) / 2;
    const reach = Math.max((range[1] - range[0]) / 2, Math.abs(azimuth - middle), 0.05);
    const first = Math.asin(clamp((azimuth - middle) / reach, -1, 1));
    this.turning = { middle, reach, first, start: performance.now(), period: 4000 + 9000 * reach };
    byId("turn").setAttribute("aria-pressed", true);
    this.wake();
  }

  stopTurning() {
    this.turning = null;
    byId("turn").setAttribute("aria-pressed", false);
  }

  nextBackground() {
    this.background = (this.background + 1) % this.backgrounds.length;
    this.backdrop = this.backgrounds[this.background];
    this.wake(false);
  }

  save() {
    this.render();
    this.canvas.toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = "dentalsplat.png";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
  }
}

const depthAxis = (pose) => [...pose.rotation.slice(6, 9), pose.translation[2]];
