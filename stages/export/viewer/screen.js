// A canvas that shows what a camera sees: when it is drawn, how finely, and how it gets elsewhere.

/**
 * What is drawn is up to the class that extends this one:
 *   panes()       what is drawn where: `{pose, left}`, in pixels of the canvas
 *   sort(panes)   ask for the depth order of the splats as the camera stands now
 *   draw(panes)
 */
class Screen {
  /** @param {HTMLCanvasElement} canvas @param {object} orbiting see `OrbitCamera` */
  constructor(canvas, orbiting) {
    this.canvas = canvas;
    this.camera = new OrbitCamera(orbiting);
    this.motion = null;     // a running transition
    this.turning = null;    // the running automatic turn
    this.held = false;      // a pointer holds it
    this.still = false;     // no transitions
    this.detail = 1;        // share of the screen's resolution while moving
    this.lastFrame = 0;
    this.gap = 0;           // between the last two frames that moved, in milliseconds
    this.moved = false;
    this.asleep = true;
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
    const moving = this.advance(now) || this.held;
    this.#adapt(moving, elapsed);
    const panes = this.panes();
    if (this.moved) {
      this.moved = false;
      this.sort(panes);
      this.settle && clearTimeout(this.settle);
      this.settle = setTimeout(() => { this.detail < 1 && this.wake(false); }, 250);
    }
    this.draw(panes);
    if (this.motion || this.turning) this.wake(true);
  }

  /** On slow devices, move at a lower resolution and come to rest at the full one. */
  #adapt(moving, elapsed) {
    // One long gap is a rest before the hand moved on; a second one after it is a slow device.
    const rested = elapsed > 1000 && !(this.gap > 1000);
    this.gap = moving ? elapsed : 0;
    if (!moving || rested) {
      this.shown = 1;
      return;
    }
    if (elapsed > 45) this.detail = Math.max(0.4, this.detail * 0.85);
    if (elapsed < 20) this.detail = Math.min(1, this.detail * 1.03);
    this.shown = this.detail;
  }

  /** Move on with what moves by itself; returns whether anything does. */
  advance(now) {
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

  /** Go to a pose; at once if `still`, or if one prefers that. @param {Pose} pose */
  approach(pose, still = false) {
    const from = this.camera.snapshot();
    this.camera.place(pose);
    const to = this.camera.snapshot();
    const arrive = () => this.camera.place(pose);  // free of rounding
    if (still || this.still || matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.motion = null;
      arrive();
    } else {
      this.camera.blend(from, to, 0);
      this.motion = { from, to, arrive, start: performance.now(), length: 600 };
    }
    this.wake();
  }

  /** Give the canvas the pixels of its place on the page; returns its width and height. */
  fitCanvas() {
    const ratio = Math.min(devicePixelRatio || 1, 2) * (this.shown ?? 1);
    const width = Math.max(2, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    return [width, height];
  }

  /** The user moved the camera. */
  leave() {
    this.motion = null;
    this.wake();
  }

  stopTurning() {
    this.turning = null;
  }
}

/** How long, in milliseconds, a graphics context may be away before that is said. */
const LONGEST_LOSS = 4000;

/**
 * Draw again when a lost graphics context comes back.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {() => void} restore makes everything on the graphics card again, and draws
 * @param {(gone: boolean) => void} tell it does not come back, or has come back after all
 */
function keepContext(canvas, restore, tell) {
  let waiting = 0;
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    waiting = setTimeout(() => tell(true), LONGEST_LOSS);
  });
  canvas.addEventListener("webglcontextrestored", () => {
    clearTimeout(waiting);
    tell(false);
    restore();
  });
}

const depthAxis = (pose) => [...pose.rotation.slice(6, 9), pose.translation[2]];
