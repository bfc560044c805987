// The bar of buttons, and the keys.

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
      picture.style.aspectRatio = view.width / view.height;  // before it is there
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

const focusBefore = new Map();

/** A panel takes the focus, and gives it back to what had it; else to the button that opens it. */
function showPanel(panel, button, shown) {
  const active = document.activeElement;
  const inside = panel.contains(active);
  if (shown && !inside) focusBefore.set(panel, active === document.body ? button : active);
  panel.hidden = !shown;
  button.setAttribute("aria-expanded", shown);
  if (shown) panel.querySelector("button").focus();
  else if (inside || active === document.body) {
    const before = focusBefore.get(panel);
    (before?.getClientRects().length ? before : button).focus({ preventScroll: true });
  }
}

function showHelp(shown) {
  showPanel(byId("help"), byId("ask"), shown);
}

function showPhoto(viewer, share) {
  if (byId("opacity").disabled) return;
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

function toggleTurn(viewer) {
  if (viewer.turning) viewer.stopTurning();
  else viewer.startTurning();
}

function addButtons(viewer) {
  byId("reset").addEventListener("click", () => viewer.goTo(viewer.scene.first));
  byId("turn").addEventListener("click", () => toggleTurn(viewer));
  byId("background").addEventListener("click", () => viewer.nextBackground());
  byId("save").addEventListener("click", () => viewer.save());
  byId("full").addEventListener("click", toggleFullScreen);
  byId("ask").addEventListener("click", () => showHelp(byId("help").hidden));
  byId("close").addEventListener("click", () => showHelp(false));
  byId("opacity").addEventListener("input", (event) => showPhoto(viewer, event.target.value));
  byId("compare").hidden = !viewer.scene.views.some((view) => view.photo);
  byId("full").hidden = !root.requestFullscreen;
  byId("bar").addEventListener("focusin", ({ target }) => {  // what is pressed must not move away
    if (target.matches(":focus-visible")) target.scrollIntoView({ block: "nearest", inline: "nearest" });
  });
}

/** Keys that work wherever the focus is but in fields: key -> what it does. */
function keysOf(viewer, tools) {
  const { store } = viewer;
  const toggle = (key) => () => tools.show({ [key]: !store.now[key] });
  const cut = (step) => {
    if (store.now.axis === "off") tools.tell("Choose a section first (X).");
    else tools.show({ at: clamp(store.now.at + step, -1, 1) });
  };
  return {
    ...steeringKeys(viewer),
    a: () => toggleTurn(viewer), b: () => viewer.nextBackground(), f: toggleFullScreen,
    h: () => showHelp(byId("help").hidden), "?": () => showHelp(byId("help").hidden),
    p: () => showPhoto(viewer, Number(byId("opacity").value) > 0 ? 0 : 100),
    r: () => viewer.goTo(viewer.scene.first), s: () => viewer.save(),
    t: () => tools.open(byId("tools").hidden),
    m: () => tools.choose("distance"), g: () => tools.choose("angle"),
    n: () => tools.choose("note"),
    u: () => tools.next("numbers"), j: () => tools.next("jaw"), x: () => tools.next("axis"),
    "[": () => cut(-0.05), "]": () => cut(0.05),
    o: toggle("mesh"), v: toggle("support"), d: toggle("sides"), l: () => tools.copyLink(),
    Backspace: () => tools.removeLast(), Delete: () => tools.removeLast(),
    Escape: () => (byId("help").hidden ? tools.back() : showHelp(false)),
  };
}

function addKeys(viewer, tools) {
  const keys = keysOf(viewer, tools);
  const fields = 'input[type="text"], select, textarea, dialog';
  addEventListener("keydown", (event) => {
    const key = keyOf(event, keys);
    if (key === null) return;
    const slides = event.target.type === "range" && key.startsWith("Arrow");
    const within = slides || event.target.matches?.(fields);
    if (within && event.key !== "Escape") return;
    const onScene = event.target === viewer.canvas;
    if (onScene && (event.key === "Enter" || event.key === " ")) {
      tools.placeAt(...viewer.crosshair());
      event.preventDefault();
      return;
    }
    if (keys[key]) {
      if (key.startsWith("Arrow") || key === "+" || key === "-") viewer.stopTurning();
      keys[key](event.shiftKey);
      event.preventDefault();
    } else if (/^[1-9]$/.test(key)) {
      viewer.goTo(Number(key) - 1);
    }
  });
}
