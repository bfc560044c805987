// Buttons, mouse, fingers and keys.

function addViewButtons(viewer) {
  for (const [index, view] of viewer.scene.views.entries()) {
    const button = document.createElement("button");
    button.title = `View ${index + 1}: where this photograph was taken`;
    button.setAttribute("aria-label", `View ${index + 1}`);
    button.setAttribute("aria-pressed", false);
    if (view.photo) {
      const picture = document.createElement("img");
      picture.src = view.photo;
      picture.alt = "";
      const number = document.createElement("span");
      number.textContent = index + 1;
      button.append(picture, number);
    } else {
      button.className = "number";
      button.textContent = index + 1;
    }
    button.addEventListener("click", () => viewer.goTo(index));
    byId("views").append(button);
  }
  const count = viewer.scene.views.length;
  byId("view-count").textContent = count === 1 ? "one photograph" : `${count} photographs`;
}

function showHelp(shown) {
  byId("help").hidden = !shown;
  byId("ask").setAttribute("aria-expanded", shown);
}

function showPhoto(viewer, share) {
  const views = viewer.scene.views;
  if (viewer.view < 0) viewer.goTo(viewer.nearestView());
  if (!views[viewer.view].photo) return;
  byId("opacity").value = share;
  viewer.wake(false);
}

function toggleFullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else root.requestFullscreen?.().catch(() => {});
}

function addButtons(viewer) {
  const toggleTurn = () => (viewer.turning ? viewer.stopTurning() : viewer.startTurning());
  byId("reset").addEventListener("click", () => viewer.goTo(viewer.scene.first));
  byId("turn").addEventListener("click", toggleTurn);
  byId("background").addEventListener("click", () => viewer.nextBackground());
  byId("save").addEventListener("click", () => viewer.save());
  byId("full").addEventListener("click", toggleFullScreen);
  byId("ask").addEventListener("click", () => showHelp(byId("help").hidden));
  byId("close").addEventListener("click", () => showHelp(false));
  byId("opacity").addEventListener("input", (event) => showPhoto(viewer, event.target.value));
  byId("compare").hidden = !viewer.scene.views.some((view) => view.photo);
  byId("full").hidden = !root.requestFullscreen;

  const turn = (azimuth, elevation) => { viewer.camera.orbit(azimuth, elevation); viewer.leave(); };
  const pan = (x, y) => { viewer.camera.pan(x, y); viewer.leave(); };
  const zoom = (factor) => { viewer.camera.zoom(factor); viewer.leave(); };
  const keys = {
    ArrowLeft: (shift) => (shift ? pan(0.03, 0) : turn(-0.05, 0)),
    ArrowRight: (shift) => (shift ? pan(-0.03, 0) : turn(0.05, 0)),
    ArrowUp: (shift) => (shift ? pan(0, 0.03) : turn(0, 0.05)),
    ArrowDown: (shift) => (shift ? pan(0, -0.03) : turn(0, -0.05)),
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
    a: toggleTurn, b: () => viewer.nextBackground(), f: toggleFullScreen,
    h: () => showHelp(byId("help").hidden), "?": () => showHelp(byId("help").hidden),
    p: () => showPhoto(viewer, Number(byId("opacity").value) > 0 ? 0 : 100),
    r: () => viewer.goTo(viewer.scene.first), s: () => viewer.save(),
    Escape: () => showHelp(false),
  };
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.type === "range") return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (keys[key]) {
      if (key.startsWith("Arrow") || key === "+" || key === "-") viewer.stopTurning();
      keys[key](event.shiftKey);
      event.preventDefault();
    } else if (/^[1-9]$/.test(key)) {
      viewer.goTo(Number(key) - 1);
    }
  });
}

function addPointers(viewer) {
  const { canvas, camera } = viewer;
  const pointers = new Map();
  const turnsPerScreen = () => Math.PI / Math.min(canvas.clientWidth, canvas.clientHeight);
  const slide = (x, y) => {
    const pose = camera.fitted(canvas.clientWidth, canvas.clientHeight);
    camera.pan(x / pose.fx, y / pose.fy);
  };

  canvas.addEventListener("pointerdown", (event) => {
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

function readAddress(viewer) {
  const wanted = new URLSearchParams(location.hash.slice(1));
  viewer.still = wanted.has("still");
  byId("bar").hidden = byId("label").hidden = wanted.has("bare");
  const number = Number(wanted.get("view"));
  const views = viewer.scene.views.length;
  return Number.isInteger(number) && number >= 1 && number <= views ? number - 1 : null;
}

function addHook(viewer, ready) {
  window.dentalsplat = {
    ready,
    views: viewer.scene.views.map(({ photo, ...pose }) => pose),
    setCamera(matrix, fx, fy, cx, cy, width, height) {
      const row = (k) => matrix.slice(4 * k, 4 * k + 3);
      viewer.stopTurning();
      viewer.leave();
      viewer.exact = {
        rotation: [...row(0), ...row(1), ...row(2)], translation: [3, 7, 11].map((k) => matrix[k]),
        fx, fy, cx, cy, width, height,
      };
      viewer.wake();
    },
    setBackground(rgb) {
      viewer.backdrop = rgb;
      viewer.wake(false);
    },
    render: () => viewer.render(),
    pixels() {
      viewer.render();
      const { gl, canvas } = viewer.renderer;
      const row = 4 * canvas.width;
      const upward = new Uint8Array(row * canvas.height);
      gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
      const downward = new Uint8Array(upward.length);
      for (let y = 0; y < canvas.height; y++) {
        downward.set(upward.subarray(y * row, (y + 1) * row), (canvas.height - 1 - y) * row);
      }
      return downward;
    },
  };
}

function start() {
  const scene = JSON.parse(byId("scene").textContent);
  const viewer = new Viewer(scene, unpacked(byId("splats").textContent));
  byId("splats").remove();  // a few megabytes
  addViewButtons(viewer);
  addButtons(viewer);
  addPointers(viewer);
  viewer.goTo(readAddress(viewer) ?? scene.first, { still: true });
  viewer.render();
  addHook(viewer, Promise.resolve());
  root.dataset.state = "ready";

  addEventListener("resize", () => viewer.wake(false));
  addEventListener("hashchange", () => {
    const view = readAddress(viewer);
    if (view !== null) viewer.goTo(view);
  });
  viewer.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  viewer.canvas.addEventListener("webglcontextrestored", () => {
    viewer.renderer.restore();
    viewer.wake();
  });
}

try {
  start();
} catch (error) {
  fail(error);
}
