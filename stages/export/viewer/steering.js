// Mouse, fingers and keys that move the camera of a `Screen`.

/** A pointer that moves less than this, in pixels, is meant to stay; and a finger. */
const TREMBLE = 5, FINGER_TREMBLE = 10;

/**
 * @param {Screen} screen
 * @param {(x: number, y: number) => void} tapped told where a pointer went down and up again
 * @param {() => boolean} zooms whether the wheel is for the scene, not for the page
 */
function addPointers(screen, tapped = () => {}, zooms = () => true) {
  const { canvas, camera } = screen;
  const pointers = new Map();
  const turnsPerScreen = () => Math.PI / Math.min(canvas.clientWidth, canvas.clientHeight);
  const slide = (x, y) => {
    const pose = camera.fitted(canvas.clientWidth, canvas.clientHeight);
    camera.pan(x / pose.fx, y / pose.fy);
  };

  let still = null;  // where the only pointer went down, as long as it has not moved
  canvas.addEventListener("pointerdown", (event) => {
    still = pointers.size === 0 && event.button <= 0 ? [event.clientX, event.clientY] : null;
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    screen.stopTurning();
    screen.held = true;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [x, y] = [now[0] - before[0], now[1] - before[1]];
    if (x === 0 && y === 0) return;
    const tremble = event.pointerType === "touch" ? FINGER_TREMBLE : TREMBLE;
    if (still && Math.hypot(now[0] - still[0], now[1] - still[1]) < tremble) return;
    still = null;
    if (pointers.size === 1) {
      if (event.shiftKey || event.buttons & 6) slide(x, y);
      else camera.orbit(-x * turnsPerScreen(), y * turnsPerScreen());
    } else if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      const gap = (p) => Math.max(8, Math.hypot(p[0] - other[0], p[1] - other[1]));
      camera.zoom(gap(before) / gap(now));
      slide(x / 2, y / 2);
    }
    pointers.set(event.pointerId, now);
    screen.leave();
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => {
      if (kind === "pointerup" && still && pointers.size === 1) tapped(...still);
      still = null;
      pointers.delete(event.pointerId);
      screen.held = pointers.size > 0;
      screen.wake(false);
    });
  }
  // After a tap browsers act as if a mouse had been pressed: the focus would leave a note just begun.
  canvas.addEventListener("touchend", (event) => event.cancelable && event.preventDefault());
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    if (!zooms()) return;
    event.preventDefault();
    screen.stopTurning();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : 1);
    camera.zoom(Math.exp(clamp(pixels, -200, 200) * 0.0015));
    screen.leave();
  }, { passive: false });
}

/** Keys that move the camera: key -> what it does. @param {Screen} screen */
function steeringKeys(screen) {
  const { camera } = screen;
  const turn = (azimuth, elevation) => { camera.orbit(azimuth, elevation); screen.leave(); };
  const pan = (x, y) => { camera.pan(x, y); screen.leave(); };
  const zoom = (factor) => { camera.zoom(factor); screen.leave(); };
  return {
    ArrowLeft: (shift) => (shift ? pan(0.03, 0) : turn(-0.05, 0)),
    ArrowRight: (shift) => (shift ? pan(-0.03, 0) : turn(0.05, 0)),
    ArrowUp: (shift) => (shift ? pan(0, 0.03) : turn(0, 0.05)),
    ArrowDown: (shift) => (shift ? pan(0, -0.03) : turn(0, -0.05)),
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
  };
}

/**
 * Which of the keys an event means, null if it is for the browser. Many layouts have brackets only
 * with Option or AltGr; where a layout has none, those in the places of the brackets are taken.
 *
 * @param {KeyboardEvent} event @param {object} keys key -> what it does
 */
function keyOf(event, keys) {
  const typed = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (event.metaKey || event.ctrlKey && !event.altKey) return null;
  if (event.altKey) return typed === "[" || typed === "]" ? typed : null;
  return keys[typed] ? typed : { BracketLeft: "[", BracketRight: "]" }[event.code] ?? typed;
}
