// Measuring, notes, overlays: what the panel, the keys and the pointer ask for.

const TOOL_HINTS = {
  turn: "",
  distance: "Choose two points: click or tap them, or bring them under the crosshair and press Enter.",
  angle: "Choose three points, the corner second: click or tap, or Enter at the crosshair.",
  note: "Choose the point that the note is about: click or tap it, or Enter at the crosshair.",
};
const STATE_WORDS = {
  numbers: { off: "No tooth numbers", fdi: "FDI numbers", universal: "Universal numbers" },
  jaw: { both: "Both jaws", upper: "Upper jaw alone", lower: "Lower jaw alone" },
  axis: {
    off: "No section", height: "Section from above", depth: "Section from the front",
    across: "Section from the patient's left",
  },
};

class Tools {
  constructor(viewer) {
    this.viewer = viewer;
    this.store = viewer.store;
    this.store.listeners.push(() => viewer.wake(false));
    this.origin = viewer.scene.id;  // the scene that marks are of
    for (const kind of ["focus", "blur"]) {  // the crosshair comes and goes
      viewer.canvas.addEventListener(kind, () => viewer.wake(false));
    }
  }

  say(text) {
    byId("live").textContent = "";
    byId("live").textContent = text;
  }

  /** Say it to everybody: what was asked for could not be done, or nothing else shows that it was. */
  tell(text, seconds = 5) {
    this.say(text);
    byId("told").textContent = text;
    byId("told").hidden = false;
    clearTimeout(this.telling);
    this.telling = setTimeout(() => { byId("told").hidden = true; }, 1000 * seconds);
  }

  /** Can the scene show this at all? */
  has(key) {
    const { scene, splats } = this.viewer;
    return {
      numbers: scene.teeth.length > 0, jaw: scene.knows.jaws, support: scene.knows.seen,
      mesh: Boolean(splats.mesh),
    }[key] ?? true;
  }

  /** A state without what the scene can't show. */
  possible(state) {
    return Object.fromEntries(Object.entries(state).filter(([key]) => this.has(key)));
  }

  show(changes) {
    const possible = this.possible(changes);
    const [key] = Object.keys(changes);
    if (!Object.keys(possible).length) {
      this.tell("This scene does not have that.");
      return;
    }
    if (changes.sides) this.#turnAside();
    this.store.set(possible);
    this.viewer.wake();
    const words = STATE_WORDS[key]?.[changes[key]];
    if (words) this.say(words);
    else if (key === "at") this.say(`Section at ${Math.round(50 + 50 * changes.at)} percent`);
    else if (typeof changes[key] === "boolean") {
      const name = { support: "Support", mesh: "Mesh", sides: "Side by side" }[key];
      this.say(`${name} ${changes[key] ? "on" : "off"}`);
    }
  }

  next(key) {
    const all = CHOICES[key];
    this.show({ [key]: all[(all.indexOf(this.store.now[key]) + 1) % all.length] });
  }

  /** From straight ahead both panes would show the same: go to the patient's right first. */
  #turnAside() {
    const { camera, scene } = this.viewer;
    const left = this.viewer.axes()[0];
    const aside = -dot(camera.rotation.slice(6, 9), left);
    if (Math.abs(aside) > 0.3) return;
    const before = camera.snapshot();
    camera.orbit(0.6, 0);
    if (-dot(camera.rotation.slice(6, 9), left) > aside) {  // that was the patient's left
      Object.assign(camera, before);
      camera.orbit(-0.6, 0);
    }
    const { centre, radius, limits } = scene.orbiting;
    camera.target = minus(centre, scaled(left, 0.45 * radius));  // the middle of that side
    camera.distance = Math.min(camera.distance * 1.15, limits.distance[1]);
    this.viewer.leave();
  }

  choose(tool) {
    const chosen = this.store.now.tool === tool ? "turn" : tool;
    this.store.set({ tool: chosen, pending: [] });
    byId("hint").textContent = TOOL_HINTS[chosen];
    this.say(TOOL_HINTS[chosen] || "Measuring off");
    if (chosen !== "turn") this.viewer.canvas.focus({ preventScroll: true });
  }

  open(shown) {
    document.body.classList.toggle("tools-open", shown);
    showPanel(byId("tools"), byId("more"), shown);
    this.viewer.wake(false);
  }

  /** Escape: one step back. @returns {boolean} whether there was something to go back from */
  back() {
    const { pending, tool } = this.store.now;
    if (pending.length) this.store.set({ pending: [] });
    else if (tool !== "turn") this.choose(tool);
    else if (!byId("tools").hidden && byId("help").hidden) this.open(false);
    else return false;
    return true;
  }

  /** The tool is used at a place on the page. */
  placeAt(x, y) {
    const { tool, pending, marks } = this.store.now;
    if (tool === "turn") return;
    if (marks.length >= MOST_MARKS) {
      this.tell("That is as many marks as the page can hold.");
      return;
    }
    const spot = this.viewer.paneAt(x, y);
    const { splats, scene } = this.viewer;
    const place = pick(splats, scene, spot, this.viewer.shownParts());
    if (!place) {
      this.tell("There is no surface at this point.");
      return;
    }
    if (pending.some(({ point }) => Math.hypot(...minus(point, place.point)) === 0)) {
      this.tell("This point is chosen already; choose another one.");
      return;
    }
    const places = [...pending, place];
    if (places.length < PLACES_OF[tool]) {
      this.store.set({ pending: places });
      this.say(`Point ${places.length}${this.#nearTooth(place)}. Choose the next one.`);
      return;
    }
    const mark = { kind: tool, places, ...(tool === "note" && { text: "" }) };
    this.store.set({ marks: [...marks, mark], pending: [] });
    const warning = markWarning(mark, scene.knows);
    if (tool === "note") this.#writeNote();
    else this.say(`${markText(mark, scene.scale)}${warning && `, ${warning}`}`);
  }

  #nearTooth({ point }) {
    const { teeth } = this.viewer.scene;
    if (!teeth.length) return "";
    const away = teeth.map(({ centre }) => Math.hypot(...minus(centre, point)));
    const least = Math.min(...away);
    if (least > 0.15 * this.viewer.scene.orbiting.radius) return "";
    const tooth = teeth[away.indexOf(least)];
    const { numbers } = this.store.now;
    return ` near tooth ${numbers === "universal" ? tooth.universal : tooth.fdi}`;
  }

  #writeNote() {
    this.choose("note");  // one note at a time
    this.open(true);
    byId("marks").querySelector("li:last-child input")?.focus();
    this.say("Write the note.");
  }

  setNote(index, text) {
    const marks = [...this.store.now.marks];
    marks[index] = { ...marks[index], text: noteText(text) };
    this.store.set({ marks });
  }

  remove(index) {
    this.store.set({ marks: this.store.now.marks.filter((_, k) => k !== index) });
    this.say("Removed.");
  }

  removeLast() {
    const { pending, marks } = this.store.now;
    if (pending.length) this.store.set({ pending: pending.slice(0, -1) });
    else if (marks.length) this.remove(marks.length - 1);
  }

  /** Marks and camera come from a link of this scene, or of another one. @param {?string} scene */
  comesFrom(scene) {
    const { id } = this.viewer.scene;
    this.origin = scene ?? id;
    const elsewhere = byId("elsewhere");
    elsewhere.hidden = this.origin === id;
    if (!elsewhere.hidden) this.tell(elsewhere.textContent.replace(/\s+/g, " "), 20);
  }

  /** Marks of another scene stay said to be so when they are passed on. */
  link() {
    const { camera, lens, scene } = this.viewer;
    const { marks } = this.store.now;
    return `#${linkOf(this.store.now, camera, lens, marks.length ? this.origin : scene.id)}`;
  }

  /** Put camera, marks and all into the address, and the address into the clipboard. */
  async copyLink() {
    const link = this.link();
    history.replaceState(null, "", link);
    const warning = link.length <= LONGEST_LINK ? "" : " It is too long to be read again.";
    try {
      await navigator.clipboard.writeText(location.href);
      this.tell(`Link copied.${warning}`);
    } catch {
      this.tell(`The link is in the address bar; copy it from there.${warning}`);
    }
  }
}
