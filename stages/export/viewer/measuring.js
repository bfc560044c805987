// Distances and angles between picked places, and how sure they are (in 19 of 20 cases).

const WIDE = 1.96;

/** Variance of a place along a vector: along its ray it is less sure than across. */
function varianceAlong(place, vector) {
  const along = dot(place.ray, vector);
  const square = dot(vector, vector);
  return place.across ** 2 * (square - along ** 2) + place.along ** 2 * along ** 2;
}

/** @returns {{value: number, off: number}} in the units of the scene */
function distanceOf([a, b], scale) {
  const value = Math.hypot(...minus(b.point, a.point));
  const towards = unit(minus(b.point, a.point));
  const variance = varianceAlong(a, towards) + varianceAlong(b, towards);
  const ofScale = value * scale.counted_percent / 100;
  return { value, off: WIDE * Math.hypot(Math.sqrt(variance), ofScale) };
}

/** The angle at the second of three places, in degrees. */
function angleOf([a, b, c]) {
  const [first, second] = [minus(a.point, b.point), minus(c.point, b.point)];
  const [u, v] = [unit(first), unit(second)];
  const cosine = clamp(dot(u, v), -1, 1);
  const sine = Math.max(Math.sqrt(1 - cosine ** 2), 1e-3);
  // How the angle changes with each of its ends, and against both with its corner.
  const byFirst = scaled(minus(scaled(u, cosine), v), 1 / (sine * (Math.hypot(...first) || 1e-9)));
  const bySecond = scaled(minus(scaled(v, cosine), u), 1 / (sine * (Math.hypot(...second) || 1e-9)));
  const variance = varianceAlong(a, byFirst) + varianceAlong(c, bySecond)
    + varianceAlong(b, plus(byFirst, bySecond));
  const degrees = 180 / Math.PI;
  return {
    value: Math.acos(cosine) * degrees,
    off: Math.min(180, WIDE * Math.sqrt(variance) * degrees),
  };
}

/** A number with so many decimals, and no minus before zeros. */
const decimals = (value, digits) => (Number(value.toFixed(digits)) || 0).toFixed(digits);

/** A length for people: with its unit and uncertainty, or said to have none. */
function lengthText(value, off, scale) {
  if (scale.unit !== "mm") {
    const digits = clamp(1 - Math.floor(Math.log10(Math.max(off, 1e-6))), 0, 6);
    return `${decimals(value, digits)} ± ${off.toFixed(digits)} (no scale)`;
  }
  return `${decimals(value, 1)} ± ${Math.max(off, 0.1).toFixed(1)} mm`;
}

/** What was measured by itself, for people: overjet and overbite have a sign, the others a side. */
function measuredText(entry, scale) {
  const signed = entry.name === "overjet" || entry.name === "overbite";
  return lengthText(signed ? entry.value : Math.abs(entry.value), entry.uncertainty, scale);
}

/** That a value is no measurement, and what else is known of it; empty where it is one. */
function estimateText({ estimated }) {
  if (!estimated) return "";
  const [share, off] = [estimated.covered_percent, estimated.covered_percent_uncertainty];
  return `estimated, ${share.toFixed(0)} ± ${off.toFixed(0)} % of the crowns covered`;
}

/** What a mark of the user's says. */
function markText(mark, scale) {
  if (mark.kind === "note") return mark.text || "(no text yet)";
  if (mark.kind === "angle") {
    const { value, off } = angleOf(mark.places);
    return `${value.toFixed(0)}° ± ${Math.max(1, off).toFixed(0)}°`;
  }
  const { value, off } = distanceOf(mark.places, scale);
  return lengthText(value, off, scale);
}

/** A warning about a mark, or nothing. */
function markWarning(mark, knows) {
  if (mark.kind === "note" || !knows.seen) return "";
  if (mark.places.some((place) => place.seen === 0)) return "reaches to where no photograph looked";
  return mark.places.some((place) => place.seen === 1) ? "rests on a single photograph" : "";
}
