// What the page shows, in one place; and the same as text in the address.

const CHOICES = {
  numbers: ["off", "fdi", "universal"],
  jaw: ["both", "upper", "lower"],
  axis: ["off", "height", "depth", "across"],
  tool: ["turn", "distance", "angle", "note"],
};
/** A link holds so many marks at most, and notes of so many letters; it is anybody's text. */
const MOST_MARKS = 60, LONGEST_NOTE = 300, LONGEST_LINK = 30000;
const PLACES_OF = { distance: 2, angle: 3, note: 1 };
const LETTERS = { distance: "d", angle: "a", note: "n" };

/** The state of the page; whoever shows a part of it is told of every change. */
class Store {
  constructor() {
    this.now = {
      numbers: "off", jaw: "both", axis: "off", at: 0, support: false, mesh: false, sides: false,
      tool: "turn", marks: [], pending: [], measure: null,
    };
    this.listeners = [];
  }

  /** @param {object} changes fields of `now` */
  set(changes) {
    const before = this.now;
    this.now = { ...before, ...changes };
    for (const tell of this.listeners) tell(this.now, before);
  }
}

const brief = (number) => String(Number(number.toPrecision(6)));

function placeText({ point, ray, across, along, seen }) {
  return [...point, ...ray, across, along, seen].map(brief).join(",");
}

/** The state and the camera as the part of an address after the `#`; and of which scene they are. */
function linkOf(state, camera, lens, scene) {
  const link = new URLSearchParams({ scene });
  const numbers = [...camera.rotation, ...camera.target, camera.distance, lens];
  link.set("camera", numbers.map(brief).join(","));
  for (const key of ["numbers", "jaw"]) {
    if (state[key] !== CHOICES[key][0]) link.set(key, state[key]);
  }
  for (const key of ["support", "mesh", "sides"]) if (state[key]) link.set(key, "1");
  if (state.axis !== "off") link.set("cut", `${state.axis},${brief(state.at)}`);
  for (const mark of state.marks) {
    link.append(LETTERS[mark.kind], mark.places.map(placeText).join(";"));
    if (mark.kind === "note") link.append("text", mark.text);
  }
  return link.toString();
}

/** Finite numbers from text with commas, exactly so many; else null. */
function numbersIn(text, count) {
  const parts = String(text).split(",");
  if (parts.length !== count || parts.some((part) => part.trim() === "")) return null;
  const numbers = parts.map(Number);
  return numbers.every((n) => Number.isFinite(n) && Math.abs(n) < 1e7) ? numbers : null;
}

function placeIn(text, limits) {
  const n = numbersIn(text, 9);
  if (!n) return null;
  const [point, ray] = [n.slice(0, 3), n.slice(3, 6)];
  if (Math.hypot(...minus(point, limits.centre)) > 1000 * limits.radius) return null;
  if (Math.abs(Math.hypot(...ray) - 1) > 0.01) return null;
  const positive = (value) => clamp(value, 1e-4 * limits.radius, limits.radius);
  return {
    point, ray: unit(ray), across: positive(n[6]), along: positive(n[7]),
    seen: clamp(Math.round(n[8]), 0, 63), jaw: 0,
  };
}

/** What no note holds: line breaks, control codes, turned directions, and what is no letter at all. */
const NO_TEXT = /[\p{Cc}\p{Cs}\p{Noncharacter_Code_Point}\u2028-\u202e\u2066-\u2069]+/gu;

/** Text of a note without what it may not hold, cut to a fair length. */
function noteText(text) {
  return [...String(text).replace(NO_TEXT, " ")]
    .slice(0, LONGEST_NOTE).join("").trim();
}

function marksIn(link, limits) {
  const texts = link.getAll("text");
  const marks = [];
  for (const [letter, value] of link) {
    const kind = Object.keys(LETTERS).find((name) => LETTERS[name] === letter);
    if (!kind) continue;
    const text = kind === "note" && noteText(texts.shift() ?? "");
    const places = value.split(";").slice(0, 4).map((place) => placeIn(place, limits));
    if (places.length !== PLACES_OF[kind] || places.some((place) => !place)) continue;
    marks.push({ kind, places, ...(kind === "note" && { text }) });
  }
  return marks.slice(0, MOST_MARKS);
}

function cameraIn(text, limits, lenses) {
  const n = numbersIn(text ?? "", 14);
  if (!n) return null;
  const [rotation, target, distance, lens] = [n.slice(0, 9), n.slice(9, 12), n[12], n[13]];
  const rows = [0, 3, 6].map((k) => rotation.slice(k, k + 3));
  const straight = rows.every((row) => Math.abs(Math.hypot(...row) - 1) < 0.01)
    && Math.abs(dot(rows[0], rows[1])) < 0.01 && dot(cross(rows[0], rows[1]), rows[2]) > 0.98;
  if (!straight || !(distance > 0) || distance > 1000 * limits.radius) return null;
  if (Math.hypot(...minus(target, limits.centre)) > 1000 * limits.radius) return null;
  if (!Number.isInteger(lens) || lens < 0 || lens >= lenses) return null;
  return { rotation: orthonormal(rotation), target, distance, lens };
}

/**
 * What an address asks for. Whatever in it is not as `linkOf` writes it is left out.
 * @param {string} hash @param {object} orbiting of the scene @param {number} lenses how many views
 * @returns {{state: object, camera: ?object, scene: ?string}} and of which scene it is; null where
 *   it does not say so, as of one that is written by hand
 */
function readLink(hash, orbiting, lenses) {
  if (hash.length > LONGEST_LINK) return { state: {}, camera: null, scene: null };
  const link = new URLSearchParams(hash.replace(/^#/, ""));
  const state = {};
  for (const key of ["numbers", "jaw"]) {
    if (CHOICES[key].includes(link.get(key))) state[key] = link.get(key);
  }
  for (const key of ["support", "mesh", "sides"]) if (link.get(key) === "1") state[key] = true;
  const [axis, at] = (link.get("cut") ?? "").split(",");
  if (CHOICES.axis.includes(axis) && numbersIn(at, 1)) {
    Object.assign(state, { axis, at: clamp(Number(at), -1, 1) });
  }
  const marks = marksIn(link, orbiting);
  if (marks.length) state.marks = marks;
  const camera = cameraIn(link.get("camera"), orbiting, lenses);
  return { state, camera, scene: link.get("scene") };
}
