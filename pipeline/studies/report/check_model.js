// What the page knows of teeth and outlines, and the file that it writes. No element is touched here.

const KIND_NAMES = { front: "from the front", right: "the patient's right", left: "the patient's left" };
const PLACES = ["central incisor", "lateral incisor", "canine", "first premolar", "second premolar",
  "first molar", "second molar", "third molar"];
const PRIMARY_PLACES = ["central incisor", "lateral incisor", "canine", "first molar", "second molar"];

const isPrimary = (tooth) => tooth > 50;
const permanentOf = (tooth) => (isPrimary(tooth) ? tooth - 40 : tooth);
const quadrantOf = (tooth) => (tooth ? Math.floor(permanentOf(tooth) / 10) : 0);
const jawOf = (tooth) => (quadrantOf(tooth) < 3 ? "upper" : "lower");
const isTooth = (tooth) => {
  const [quadrant, place] = [Math.floor(tooth / 10), tooth % 10];
  return quadrant >= 1 && quadrant <= 8 && place >= 1 && place <= (quadrant > 4 ? 5 : 8);
};
// Where a tooth stands in its jaw: -8 (the patient's right) to 8 (left), as a photograph has it.
const standing = (tooth) => {
  const place = tooth % 10;
  return [1, 4].includes(quadrantOf(tooth)) ? -place : place;
};
// The tooth there; 0 beyond the last one of the jaw.
const numberAt = (jaw, stand, primary) => {
  if (Math.abs(stand) > (primary ? 5 : 8)) return 0;
  const quadrant = jaw === "upper" ? (stand < 0 ? 1 : 2) : (stand < 0 ? 4 : 3);
  return (quadrant + (primary ? 4 : 0)) * 10 + Math.abs(stand);
};
const otherSide = (tooth) => {
  const quadrant = Math.floor(tooth / 10);
  return 10 * (quadrant % 2 ? quadrant + 1 : quadrant - 1) + tooth % 10;
};
const nameOf = (tooth) => {
  const primary = isPrimary(tooth);
  const side = standing(tooth) < 0 ? "right" : "left";
  const place = (primary ? PRIMARY_PLACES : PLACES)[tooth % 10 - 1];
  return `${jawOf(tooth)} ${side} ${primary ? "primary " : ""}${place}`;
};

// -- polygons: lists of [x, y] ---------------------------------------------------------------------

const turned = (polygon) => [...polygon.slice(1), polygon[0]];
const cross = (polygon) => polygon.map(([x, y], k) => {
  const [u, v] = polygon[(k + 1) % polygon.length];
  return x * v - u * y;
});
const areaOf = (polygon) => Math.abs(cross(polygon).reduce((sum, value) => sum + value, 0)) / 2;
const centreOf = (polygon) => {
  const parts = cross(polygon);
  const whole = 3 * parts.reduce((sum, value) => sum + value, 0);
  if (Math.abs(whole) < 1e-9) return polygon[0];
  const after = turned(polygon);
  return [0, 1].map((axis) =>
    parts.reduce((sum, part, k) => sum + part * (polygon[k][axis] + after[k][axis]), 0) / whole);
};
const extent = (polygon) => {
  const [x, y] = [0, 1].map((axis) => polygon.map((point) => point[axis]));
  return [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)];
};
const contains = (polygon, [x, y]) => {
  let inside = false;
  polygon.forEach(([x1, y1], k) => {
    const [x2, y2] = polygon[(k + 1) % polygon.length];
    if ((y1 > y) !== (y2 > y) && x < (x2 - x1) * (y - y1) / (y2 - y1) + x1) inside = !inside;
  });
  return inside;
};
const borderDistance = (polygon, [x, y]) => Math.min(...polygon.map(([x1, y1], k) => {
  const [x2, y2] = polygon[(k + 1) % polygon.length];
  const [dx, dy] = [x2 - x1, y2 - y1];
  const share = Math.max(0, Math.min(1, ((x - x1) * dx + (y - y1) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(x - x1 - share * dx, y - y1 - share * dy);
}));
// A place well inside: the centre, or where that lies outside (a banana), the roomiest of a grid.
const innerPoint = (polygon) => {
  const centre = centreOf(polygon);
  const [left, top, right, bottom] = extent(polygon);
  const room = Math.min(right - left, bottom - top) / 8;
  if (contains(polygon, centre) && borderDistance(polygon, centre) > room) return centre;
  let best = [polygon[0], -1];
  for (let i = 1; i < 12; i++) {
    for (let j = 1; j < 12; j++) {
      const point = [left + (right - left) * i / 12, top + (bottom - top) * j / 12];
      if (!contains(polygon, point)) continue;
      const distance = borderDistance(polygon, point);
      if (distance > best[1]) best = [point, distance];
    }
  }
  return best[0];
};
const clipped = (polygon, heights) => polygon.flatMap((point, k) => {
  const before = (k + polygon.length - 1) % polygon.length;
  const [was, now] = [heights[before], heights[k]];
  const kept = [];
  if ((was < 0) !== (now < 0)) {
    const share = was / (was - now);
    kept.push([0, 1].map((axis) =>
      polygon[before][axis] + share * (point[axis] - polygon[before][axis])));
  }
  if (now >= 0) kept.push(point);
  return kept;
});
// The two parts of a polygon beside the line through two places, or null where it misses.
const splitPolygon = (polygon, [x1, y1], [x2, y2]) => {
  const heights = polygon.map(([x, y]) => (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1));
  const parts = [clipped(polygon, heights), clipped(polygon, heights.map((height) => -height))];
  if (parts.some((part) => part.length < 3)) return null;
  const areas = parts.map(areaOf);
  return Math.min(...areas) < 0.05 * (areas[0] + areas[1]) ? null : parts;
};

// -- a photograph ----------------------------------------------------------------------------------

const along = (photo, crown) => {
  const [x, y] = centreOf(crown.outline);
  return Math.cos(photo.roll) * x + Math.sin(photo.roll) * y;
};
const rowOf = (photo, jaw) => photo.crowns.filter((crown) => crown.jaw === jaw)
  .sort((a, b) => along(photo, a) - along(photo, b));
const isUsed = (photo) => photo.use ?? !photo.aside;
const kindOf = (photo) => photo.kindSaid ?? photo.kind;
const isUnsure = (crown, from) => !crown.number || crown.doubt >= from;

// Two neighbours of a row, which may be parts of one crown.
const sideBySide = (photo, [a, b]) => a.jaw === b.jaw
  && Math.abs(rowOf(photo, a.jaw).indexOf(a) - rowOf(photo, b.jaw).indexOf(b)) === 1;

// What can't be right, or is seldom so (possible): [{ text, possible, crowns: ids }].
const problemsOf = (photo) => {
  const found = [];
  const numbered = photo.crowns.filter((crown) => crown.number);
  for (const number of new Set(numbered.map((crown) => crown.number))) {
    const same = numbered.filter((crown) => crown.number === number);
    if (same.length > 1) {
      const possible = same.length === 2 && sideBySide(photo, same);
      const often = possible ? "twice: right only for two parts of one crown"
        : same.length === 2 ? "twice" : `${same.length} times`;
      found.push({ text: `${number} stands ${often}`, possible,
        crowns: same.map((crown) => crown.id) });
    }
  }
  for (const jaw of ["upper", "lower"]) {
    const row = rowOf(photo, jaw).filter((crown) => crown.number);
    const steps = row.slice(1).map((crown, k) => [row[k], crown])
      .filter(([a, b]) => standing(b.number) < standing(a.number));
    if (row.length > 2 && steps.length === row.length - 1) {
      found.push({ text: `the ${jaw} numbers run backwards: is the photograph mirrored?`, crowns: [] });
    } else {
      steps.forEach(([a, b]) => found.push({
        text: `${a.number} and ${b.number} are out of order: right only for teeth that have changed places`,
        possible: true, crowns: [a.id, b.id] }));
    }
  }
  const lean = numbered.reduce((sum, crown) => sum + Math.sign(standing(crown.number)), 0);
  const side = kindOf(photo) === "right" ? 1 : kindOf(photo) === "left" ? -1 : 0;
  if (side && Math.abs(lean) > 3 && Math.sign(lean) === side) {
    found.push({ text: `it is called ${KIND_NAMES[kindOf(photo)]}, but most numbers are of the other `
      + "side", crowns: [] });
  }
  return found;
};

// -- the file --------------------------------------------------------------------------------------

const quoted = (text) => JSON.stringify(text).replace(/[\u007f-\u009f\u2028\u2029\ufeff]/g,
  (letter) => `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`);
const place = (point) => `[${point.map((value) => Math.round(value * 10) / 10).join(", ")}]`;
// Pixels of the picture as shown, which may be turned over, and of the photograph as it was taken.
const turnedOver = (photo, [x, y]) => [photo.mirrored ? photo.width - x : x, y];
const original = (photo, point) =>
  turnedOver(photo, point).map((value, axis) => value * photo.scale[axis] + photo.corner[axis]);
const shownAt = (photo, at) => turnedOver(photo,
  at.map((value, axis) => (value - photo.corner[axis]) / photo.scale[axis]));
const isNear = ({ outline }, point) => contains(outline, point)
  || borderDistance(outline, point) <= (extent(outline)[2] - extent(outline)[0]) / 2;
// What was said of a crown last, and can be taken back: its number; the split that it is a part of.
const numberSaid = (photo, crown) => photo.entries.findLast((entry) => entry.tooth
  && entry.tooth === crown.number && isNear(crown, shownAt(photo, entry.at)));
const splitSaid = (photo, crown) => photo.entries.findLast((entry) => entry.split
  && entry.was.some(({ outline }) => contains(outline, innerPoint(crown.outline))));
// The numbers said of a crown since it was split: several where parts were joined to it.
const numbersWithin = (photo, crown) => photo.entries
  .slice(photo.entries.indexOf(splitSaid(photo, crown)) + 1)
  .filter((entry) => entry.tooth && contains(crown.outline, shownAt(photo, entry.at)));
// A crown with the number that was said of it: a run that was refused has not given it.
const asSaid = (photo, crown) => {
  const [number, ...others] = new Set(numbersWithin(photo, crown).map(({ tooth }) => tooth));
  return !number || others.length ? crown : { ...crown, number, doubt: 0, jaw: jawOf(number) };
};
// Numbers and splits of what isn't read any more: they keep a run from going on.
const lostEntries = (photo) => photo.entries.filter((entry) => (entry.tooth || entry.split)
  && !entry.was.length && !photo.crowns.some((crown) => isNear(crown, shownAt(photo, entry.at))));
// What is said of a picture shown turned over is said of a mirror image.
const mirroredOf = (photo) => photo.mirroredSaid ?? (photo.mirrored
  && (photo.kindSaid !== null || photo.entries.some((entry) => entry.tooth)) ? true : null);
const entryLine = (entry) => {
  const what = entry.tooth ? `tooth: ${entry.tooth}`
    : entry.split ? `split: [${entry.split.map(place).join(", ")}]` : "remove: true";
  return `      - {at: ${place(entry.at)}, ${what}}`;
};
const yamlOf = (photos) => {
  const lines = ["# Written by check.html of dentalsplat. Places are pixels of the photograph, upright."];
  for (const photo of photos) {
    const said = [photo.use, photo.kindSaid, photo.mirroredSaid].some((value) => value !== null)
      || photo.entries.length;
    if (!said) continue;
    if (lines.length === 1) lines.push("photographs:");
    lines.push(`  ${quoted(photo.name)}:`);
    if (photo.use !== null) lines.push(`    use: ${photo.use}`);
    if (photo.kindSaid !== null) lines.push(`    kind: ${photo.kindSaid}`);
    if (mirroredOf(photo) !== null) lines.push(`    mirrored: ${mirroredOf(photo)}`);
    if (photo.entries.length) lines.push("    crowns:", ...photo.entries.map(entryLine));
    if (photo.sha256) lines.push(`    sha256: ${quoted(photo.sha256)}`);
  }
  return `${lines.join("\n")}\n`;
};
