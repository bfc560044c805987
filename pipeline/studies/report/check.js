// The page: photographs with crowns, the panel of the chosen crown, undo and saving.

const data = JSON.parse(document.getElementById("data").textContent);
const find = (id) => document.getElementById(id);
const make = (tag, given = {}, ...inside) => {
  const svg = ["svg", "g", "image", "polygon", "text", "line"].includes(tag);
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag)
    : document.createElement(tag);
  for (const [name, value] of Object.entries(given)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null) made.setAttribute(name, value);
  }
  made.append(...inside.filter((child) => child !== null));
  return made;
};

let nextId = 0;
const withId = (crown) => ({ ...crown, id: nextId++ });
const photos = data.photographs.map((photo) => ({
  ...photo, crowns: photo.crowns.map(withId), removed: photo.removed.map(withId), entries: photo.earlier.crowns,
  use: photo.earlier.use, kindSaid: photo.earlier.kind, mirroredSaid: photo.earlier.mirrored,
}));
photos.forEach((photo) => { photo.crowns = photo.crowns.map((crown) => asSaid(photo, crown)); });
const changing = ["crowns", "removed", "entries", "use", "kindSaid", "kind", "mirrored",
  "mirroredSaid", "roll"];
const past = [];
let saved = yamlOf(photos);
let savedOnce = false;
let chosen = null; // { photo, id }
let cut = null; // { from, to } while a crown is being split
let typed = "";

const chosenCrown = () => chosen?.photo.crowns.find((crown) => crown.id === chosen.id) ?? null;
const say = (text, bad = false) => {
  find("said").textContent = text;
  find("said").classList.toggle("bad", bad);
};

// -- what can be done ------------------------------------------------------------------------------

const stateNow = () => photos.map((photo) => changing.map((name) => photo[name]));
const takeState = (state) => {
  photos.forEach((photo, k) => changing.forEach((name, n) => { photo[name] = state[k][n]; }));
};
const change = (deed) => {
  past.push({ state: stateNow(), chosen });
  deed();
  [cut, typed] = [null, ""];
  find("next").hidden = true;
  remember();
  draw();
};
const undo = () => {
  const before = past.pop();
  if (!before) return;
  takeState(before.state);
  [chosen, cut, typed] = [before.chosen, null, ""];
  remember();
  say("Undone.");
  draw();
};
const put = (photo, crown, number) => {
  // What was said of it before is said anew, of each of its parts where those were joined.
  const earlier = numbersWithin(photo, crown);
  const was = numberSaid(photo, crown)?.was ?? [crown];
  photo.entries = earlier.length
    ? photo.entries.map((entry) => (earlier.includes(entry) ? { ...entry, tooth: number } : entry))
    : [...photo.entries, { at: original(photo, innerPoint(crown.outline)), tooth: number, was }];
  photo.crowns = photo.crowns.map((other) => (other.id !== crown.id ? other
    : { ...other, number, doubt: 0, said: true, jaw: jawOf(number) }));
};
const setNumber = (number) => {
  const crown = chosenCrown();
  if (!crown) return;
  if (!isTooth(number)) {
    say(`${number} is no FDI number: 11-18, 21-28, 31-38, 41-48; primary 51-55 to 81-85.`, true);
    return;
  }
  change(() => put(chosen.photo, crown, number));
  say(`${number}, ${nameOf(number)}.`);
};
const numberRow = () => {
  const { photo } = chosen;
  const row = rowOf(photo, chosenCrown().jaw);
  const at = row.findIndex((crown) => crown.id === chosen.id);
  let count = 0;
  change(() => row.forEach((crown, k) => {
    let stand = standing(row[at].number) + k - at;
    if (Math.sign(stand) !== Math.sign(standing(row[at].number))) stand += Math.sign(k - at);
    const primary = crown.number && isPrimary(crown.number) && Math.abs(stand) <= 5;
    const number = numberAt(crown.jaw, stand, primary);
    if (!isTooth(number) || (crown.number === number && crown.doubt === 0)) return;
    put(photo, crown, number);
    count += 1;
  }));
  say(`${count} more crowns numbered, from ${row[at].number} on to both sides.`);
};
const confirm = (photo) => {
  change(() => photo.crowns.filter((crown) => crown.number && crown.doubt)
    .forEach((crown) => put(photo, crown, crown.number)));
  say(`The numbers in ${photo.name} are taken as certain.`);
};
const remove = () => {
  const { photo } = chosen;
  const crown = chosenCrown();
  const row = rowOf(photo, crown.jaw);
  const at = row.indexOf(crown);
  change(() => {
    const entry = { at: original(photo, innerPoint(crown.outline)), remove: true };
    photo.entries = [...photo.entries, entry];
    photo.removed = [...photo.removed, { ...crown, at: entry.at }];
    photo.crowns = photo.crowns.filter((other) => other !== crown);
    const near = row[at + 1] ?? row[at - 1];
    chosen = near ? { photo, id: near.id } : null;
  });
  say("Removed: it is no tooth.");
};
const bringBack = (photo, { at, ...crown }) => {
  change(() => {
    const index = photo.entries.findIndex((entry) => entry.remove && String(entry.at) === String(at));
    photo.entries = photo.entries.filter((_, k) => k !== index);
    photo.removed = photo.removed.filter((other) => other.id !== crown.id);
    if (!crown.outline.length) return;
    photo.crowns = [...photo.crowns, crown];
    if (isUsed(photo)) chosen = { photo, id: crown.id };
  });
  say("Brought back.");
};
// What was said of a crown, now or before, is said no longer: its number, else the split it is of.
const takeBackNumber = (photo, crown) => {
  const entry = numberSaid(photo, crown);
  const { number = 0, doubt = 1, jaw = crown.jaw, said = false } = entry.was[0] ?? {};
  const parts = numbersWithin(photo, crown).filter((other) => other.tooth === crown.number);
  change(() => {
    photo.entries = photo.entries.filter((other) => other !== entry && !parts.includes(other));
    photo.crowns = photo.crowns.map((other) => (other.id !== crown.id ? other
      : { ...other, number, doubt, jaw, said }));
  });
  say(`Taken back: it ${number ? `is ${number}` : "has no number"} again.`);
};
const takeBackSplit = (photo, crown) => {
  const entry = splitSaid(photo, crown);
  const inside = (point) => entry.was.some(({ outline }) => contains(outline, point));
  change(() => {
    const at = photo.entries.indexOf(entry);
    photo.entries = photo.entries.filter((other, k) => k < at
      || (k > at && !inside(shownAt(photo, other.at))));
    const isPart = ({ outline }) => outline.length && inside(innerPoint(outline));
    const whole = entry.was.map(withId);
    photo.crowns = [...photo.crowns.filter((other) => !isPart(other)), ...whole];
    photo.removed = photo.removed.filter((other) => !isPart(other));
    chosen = { photo, id: whole[0].id };
  });
  say("Taken back: it is not split.");
};
const takeBack = () => {
  const { photo } = chosen;
  const crown = chosenCrown();
  if (numberSaid(photo, crown)) takeBackNumber(photo, crown);
  else if (splitSaid(photo, crown)) takeBackSplit(photo, crown);
  else say("Nothing was said of this crown.");
};
const takeBackLost = (photo, entry) => {
  change(() => { photo.entries = photo.entries.filter((other) => other !== entry); });
  say("Taken back.");
};
const turnOver = (photo) => {
  change(() => {
    photo.mirrored = !photo.mirrored;
    photo.mirroredSaid = photo.mirrored;
    photo.roll = -photo.roll;
    photo.kind = { right: "left", left: "right" }[photo.kind] ?? photo.kind;
    const over = (crown) => ({ ...crown,
      outline: crown.outline.map(([x, y]) => [photo.width - x, y]),
      number: crown.number && crown.doubt ? otherSide(crown.number) : crown.number,
      offered: crown.offered.map(([tooth, share]) => [otherSide(tooth), share]) });
    for (const kind of ["crowns", "removed"]) photo[kind] = photo[kind].map(over);
    photo.entries = photo.entries.map((entry) => ({ ...entry, was: entry.was?.map(over) }));
  });
  say(photo.mirrored ? `${photo.name} is taken as a mirror image and turned over.`
    : `${photo.name} is taken as it is.`);
};
const startCut = () => {
  const crown = chosenCrown();
  const [x, y] = centreOf(crown.outline);
  const [left, top, right, bottom] = extent(crown.outline);
  const half = Math.hypot(right - left, bottom - top) * 0.55;
  const [dx, dy] = [-Math.sin(chosen.photo.roll) * half, Math.cos(chosen.photo.roll) * half];
  cut = { from: [x - dx, y - dy], to: [x + dx, y + dy], step: (right - left) / 30 };
  say("Draw a line across the crown. Keys: arrows move it, Shift turns it, Enter cuts, Esc ends.");
  draw();
};
const finishCut = () => {
  const { photo } = chosen;
  const crown = chosenCrown();
  const parts = splitPolygon(crown.outline, cut.from, cut.to);
  if (!parts) {
    say("The line doesn't cross the crown; draw it from one side to the other.", true);
    return;
  }
  const { from, to } = cut;
  change(() => {
    photo.entries = [...photo.entries, { at: original(photo, innerPoint(crown.outline)),
      split: [original(photo, from), original(photo, to)], was: [crown] }];
    const made = parts.map((outline) => withId({ ...crown, outline, number: 0, doubt: 1, said: false }));
    photo.crowns = photo.crowns.flatMap((other) => (other === crown ? made : [other]));
    chosen = { photo, id: rowOf(photo, crown.jaw).find((other) => made.includes(other)).id };
  });
  say("Split in two. Now number both.");
};
const moveCut = (key, turn) => {
  const [sign, flat] = [["ArrowLeft", "ArrowUp"].includes(key) ? -1 : 1, key.match(/Left|Right/)];
  const { from, to, step } = cut;
  if (turn) {
    const [x, y] = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2];
    const [c, s] = [Math.cos(0.06 * sign), Math.sin(0.06 * sign)];
    const around = ([u, v]) => [x + c * (u - x) - s * (v - y), y + s * (u - x) + c * (v - y)];
    cut = { ...cut, from: around(from), to: around(to) };
  } else {
    const shifted = ([u, v]) => (flat ? [u + sign * step, v] : [u, v + sign * step]);
    cut = { ...cut, from: shifted(from), to: shifted(to) };
  }
  draw();
};
const choose = (photo, id) => {
  chosen = id === null ? null : { photo, id };
  [cut, typed] = [null, ""];
  say("");
  draw();
};
const step = (key) => {
  const { photo } = chosen;
  const crown = chosenCrown();
  const row = rowOf(photo, crown.jaw);
  const at = row.indexOf(crown);
  if (key === "ArrowLeft" || key === "ArrowRight") {
    const next = row[at + (key === "ArrowLeft" ? -1 : 1)];
    if (next) choose(photo, next.id);
    return;
  }
  const other = rowOf(photo, crown.jaw === "upper" ? "lower" : "upper");
  const here = along(photo, crown);
  const near = other.reduce((best, candidate) => (best === null
    || Math.abs(along(photo, candidate) - here) < Math.abs(along(photo, best) - here)
    ? candidate : best), null);
  if (near && (key === "ArrowUp") === (crown.jaw === "lower")) choose(photo, near.id);
};

// -- keys ------------------------------------------------------------------------------------------

document.addEventListener("keydown", (event) => {
  const writing = event.target.matches("input, select, textarea");
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z" && !writing) {
    event.preventDefault();
    undo();
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || !chosen || writing) return;
  const inside = event.target.closest(".chip, #photographs") || event.target === document.body;
  const { key } = event;
  if (key === "Escape") {
    if (cut) [cut] = [null];
    else chosen = null;
    say("");
    draw();
  } else if (!inside) {
    return;
  } else if (key.startsWith("Arrow")) {
    if (cut) moveCut(key, event.shiftKey);
    else step(key);
  } else if (key === "Enter" && cut) {
    finishCut();
  } else if (/^[0-9]$/.test(key) && !cut) {
    typed = (typed + key).slice(-2);
    if (typed.length === 2) {
      setNumber(Number(typed));
      typed = "";
    } else {
      say(`${typed}_`);
    }
  } else if ((key === "Delete" || key === "Backspace") && !cut) {
    remove();
  } else if (key.toLowerCase() === "s" && !cut) {
    startCut();
  } else if (key.toLowerCase() === "t" && !cut) {
    takeBack();
  } else {
    return;
  }
  event.preventDefault();
});
{% include "check_memory.js" %}
{% include "check_view.js" %}
