// What is drawn over the scene: numbers of the teeth, measurements, notes, the crosshair. It is a
// picture for the eye; the same is in the panel as text, so that it is hidden from screen readers.

const SVG = "http://www.w3.org/2000/svg";
/** A tooth's number is shown up to this angle (its cosine) from where it was photographed. */
const FACING = 0.15;
const UNSURE_NUMBER = 0.2;
/** What is nearer than a tooth by this share of the scene's radius covers it. */
const BEFORE = 0.12;

class Marks {
  constructor(viewer) {
    this.viewer = viewer;
    this.drawing = byId("drawing");
  }

  #add(kind, attributes, text) {
    const element = document.createElementNS(SVG, kind);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== undefined) element.textContent = text;
    this.drawing.append(element);
  }

  /** @param {{pose: Pose, left: number}[]} panes */
  draw(panes) {
    const { canvas, store, scene } = this.viewer;
    const { clientWidth: width, clientHeight: height } = canvas;
    this.drawing.replaceChildren();
    this.drawing.setAttribute("viewBox", `0 0 ${width} ${height}`);  // on paper it has another size
    byId("stage").style.setProperty("--shape", width / height);
    this.scale = width / canvas.width;
    for (const pane of panes) {
      if (store.now.numbers !== "off") this.#numbers(pane);
      for (const mark of store.now.marks) this.#mark(pane, mark);
      for (const place of store.now.pending) this.#dot(this.#at(pane, place.point));
      const automatic = scene.measurements.find(({ name }) => name === store.now.measure);
      if (automatic?.points) this.#measurement(pane, automatic);
    }
    if (panes.length > 1) {
      const x = panes[1].left * this.scale;
      this.#add("line", { x1: x, x2: x, y1: 0, y2: "100%", class: "divide" });
    }
    if (store.now.tool !== "turn") this.#crosshair();
  }

  /** What is drawn, but for the crosshair, as an image with the rules of the page's style. */
  async picture(width, height) {
    const drawing = this.drawing.cloneNode(true);
    drawing.querySelectorAll("path").forEach((path) => path.remove());
    const rules = [...document.styleSheets].flatMap((sheet) => [...sheet.cssRules])
      .filter(({ selectorText }) => selectorText?.startsWith("#drawing "));
    const style = document.createElementNS(SVG, "style");
    style.textContent = `svg { font-family: system-ui, sans-serif; } ${rules.map((rule) => rule.cssText).join(" ")}`;
    drawing.append(style);
    drawing.setAttribute("width", width);
    drawing.setAttribute("height", height);
    const image = new Image();
    image.src = `data:image/svg+xml,${encodeURIComponent(new XMLSerializer().serializeToString(drawing))}`;
    await image.decode();
    return image;
  }

  /** A point of the world in pixels of the page, or null behind the camera or outside its pane. */
  #at({ pose, left }, point) {
    const p = plus(applied(pose.rotation, point), pose.translation);
    if (p[2] <= 0) return null;
    const [x, y] = [pose.fx * p[0] / p[2] + pose.cx, pose.fy * p[1] / p[2] + pose.cy];
    if (x < 0 || y < 0 || x > pose.width || y > pose.height) return null;
    return [(x + left) * this.scale, y * this.scale];
  }

  #numbers(pane) {
    const { scene, store } = this.viewer;
    const eye = centreOf(pane.pose.rotation, pane.pose.translation);
    const { viewer } = this;
    const { cut } = viewer.shownParts();
    const moving = viewer.held || viewer.motion || viewer.turning;
    const hidden = moving ? [] : covered(
      viewer.splats, pane.pose, scene.teeth.map(({ centre }) => centre),
      BEFORE * scene.orbiting.radius, viewer.shownParts());
    for (const [index, tooth] of scene.teeth.entries()) {
      if (hidden[index] || dot(cut, tooth.centre) > cut[3]) continue;
      if (store.now.jaw !== "both" && store.now.jaw !== tooth.jaw) continue;
      if (dot(unit(minus(eye, tooth.centre)), tooth.towards) < FACING) continue;
      const at = this.#at(pane, tooth.centre);
      if (!at) continue;
      const name = store.now.numbers === "fdi" ? tooth.fdi : tooth.universal;
      const text = `${name}${tooth.doubt > UNSURE_NUMBER ? "?" : ""}`;
      this.#add("text", { x: at[0], y: at[1], class: "number" }, text);
    }
  }

  #dot(at) {
    if (at) this.#add("circle", { cx: at[0], cy: at[1], r: 5, class: "place" });
  }

  #line(ends) {
    for (let k = 1; k < ends.length; k++) {
      const [a, b] = [ends[k - 1], ends[k]];
      if (!a || !b) continue;
      for (const kind of ["under", "over"]) {
        this.#add("line", { x1: a[0], y1: a[1], x2: b[0], y2: b[1], class: kind });
      }
    }
  }

  #label(at, text) {
    if (at) this.#add("text", { x: at[0], y: at[1] - 12, class: "said" }, text);
  }

  #mark(pane, mark) {
    const { scene, store } = this.viewer;
    const ends = mark.places.map((place) => this.#at(pane, place.point));
    this.#line(ends);
    ends.forEach((end) => this.#dot(end));
    const index = store.now.marks.indexOf(mark) + 1;
    const text = markText(mark, scene.scale);
    if (mark.kind === "note") {
      const letters = [...text];  // a picture can't hold half of one
      this.#label(ends[0], `${index}: ${letters.length > 40 ? `${letters.slice(0, 39).join("")}…` : text}`);
    } else if (mark.kind === "angle") {
      this.#label(ends[1], text);
    } else if (ends[0] && ends[1]) {
      this.#label([(ends[0][0] + ends[1][0]) / 2, (ends[0][1] + ends[1][1]) / 2], text);
    }
  }

  #measurement(pane, entry) {
    const ends = entry.points.map((point) => this.#at(pane, point));
    this.#line(ends);
    ends.forEach((end) => this.#dot(end));
    const { scale } = this.viewer.scene;
    const text = measuredText(entry, scale);
    if (ends[0] && ends[1]) {
      const middle = [(ends[0][0] + ends[1][0]) / 2, (ends[0][1] + ends[1][1]) / 2];
      this.#label(middle, `${entry.title}${entry.estimated ? ", estimated:" : ""} ${text}`);
    }
  }

  #crosshair() {
    if (document.activeElement !== this.viewer.canvas) return;
    const [x, y] = this.viewer.crosshair();
    for (const kind of ["under", "over"]) {
      this.#add("path", { d: `M${x - 12} ${y}h24M${x} ${y - 12}v24`, class: kind });
    }
  }
}
