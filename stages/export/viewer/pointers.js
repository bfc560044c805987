// Mouse and fingers on the scene.

/** A pointer that moves less than this, in pixels, is meant to stay. */
const TREMBLE = 5;

function addPointers(viewer, tools) {
  const { canvas, camera } = viewer;
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
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    viewer.stopTurning();
    viewer.held = true;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [x, y] = [now[0] - before[0], now[1] - before[1]];
    if (x === 0 && y === 0) return;
    if (still && Math.hypot(now[0] - still[0], now[1] - still[1]) < TREMBLE) return;
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
    viewer.leave();
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => {
      if (kind === "pointerup" && still && pointers.size === 1) tools.placeAt(...still);
      still = null;
      pointers.delete(event.pointerId);
      viewer.held = pointers.size > 0;
      viewer.wake(false);
    });
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    viewer.stopTurning();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : 1);
    camera.zoom(Math.exp(clamp(pixels, -200, 200) * 0.0015));
    viewer.leave();
  }, { passive: false });
}
