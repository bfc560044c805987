// Which place of the surface lies under a pixel: the same blending as on screen, for one pixel, on
// the processor, so that it is exact and needs nothing back from the graphics card.

/** A quaternion's rotation, rows, from its 32 bits (see `packed_quaternions` in compact.py). */
function rotationOf(bits) {
  const rest = [0, 10, 20].map((shift) => (((bits >>> shift) & 1023) / 1023 * 2 - 1) * Math.SQRT1_2);
  const q = [...rest];
  q.splice(bits >>> 30, 0, Math.sqrt(Math.max(0, 1 - dot(rest, rest))));
  const [w, x, y, z] = q;
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

const jawOf = (flags) => flags & 3;
const seenBy = (flags) => flags >> 2;

/** Is a splat drawn, with a jaw (0: both) and a section plane chosen? */
function isShown(splats, k, { jaw, cut }) {
  if (jaw > 0 && jawOf(splats.flags[k]) !== jaw) return false;
  const p = splats.positions;
  return cut[0] * p[3 * k] + cut[1] * p[3 * k + 1] + cut[2] * p[3 * k + 2] <= cut[3];
}

/** Opacity of one splat at a pixel; the arithmetic is that of splat.vert.glsl. */
function alphaAt(splats, k, p, pose, offset, format) {
  const { low_pass: lowPass, alpha_max: alphaMax } = format.rasterizer;
  const axes = product(pose.rotation, rotationOf(splats.packed[4 * format.texels * k + 3]));
  let a = lowPass, b = 0, c = lowPass;
  for (let j = 0; j < 3; j++) {
    const size = splats.scales[3 * k + j];
    const x = pose.fx / p[2] * (axes[j] - p[0] / p[2] * axes[6 + j]) * size;
    const y = pose.fy / p[2] * (axes[3 + j] - p[1] / p[2] * axes[6 + j]) * size;
    a += x * x;
    b += x * y;
    c += y * y;
  }
  const [u, v] = offset;
  const power = (c * u * u - 2 * b * u * v + a * v * v) / (a * c - b * b);
  return Math.min(alphaMax, splats.opacities[k] * Math.exp(-0.5 * power));
}

/** The splats over a pixel: their depth and opacity, nearest first. */
function layersAt(splats, format, pose, x, y, shown) {
  const { rotation: R, translation: t } = pose;
  const { near, alpha_min: alphaMin } = format.rasterizer;
  const { positions, scales } = splats;
  const layers = [];
  for (let k = 0; k < format.count; k++) {
    const [X, Y, Z] = [positions[3 * k], positions[3 * k + 1], positions[3 * k + 2]];
    const z = R[6] * X + R[7] * Y + R[8] * Z + t[2];
    if (z < near) continue;
    const p = [R[0] * X + R[1] * Y + R[2] * Z + t[0], R[3] * X + R[4] * Y + R[5] * Z + t[1], z];
    const u = x - (pose.fx * p[0] / z + pose.cx);
    const v = y - (pose.fy * p[1] / z + pose.cy);
    const size = Math.max(scales[3 * k], scales[3 * k + 1], scales[3 * k + 2]);
    const slant = Math.hypot(1, p[0] / z, p[1] / z);
    const reach = 3.5 * (1 + size * slant * Math.max(pose.fx, pose.fy) / z);
    if (Math.abs(u) > reach || Math.abs(v) > reach || !isShown(splats, k, shown)) continue;
    const alpha = alphaAt(splats, k, p, pose, [u, v], format);
    if (alpha >= alphaMin) layers.push({ z, alpha, splat: k });
  }
  return layers.sort((first, second) => first.z - second.z);
}

/**
 * Which points have something before them, roughly: several opaque splats near the same pixel that
 * are nearer by a margin.
 * @param {number[][]} points of the world @param {number} margin in the world
 * @returns {boolean[]}
 */
function covered(splats, pose, points, margin, shown) {
  const { rotation: R, translation: t } = pose;
  const near = 0.012 * Math.max(pose.width, pose.height);
  const cells = new Map();
  const targets = points.map((point, index) => {
    const p = plus(applied(R, point), t);
    const target = { x: pose.fx * p[0] / p[2] + pose.cx, y: pose.fy * p[1] / p[2] + pose.cy,
      z: p[2] - margin, before: 0 };
    for (const dx of [-1, 0, 1]) {
      for (const dy of [-1, 0, 1]) {
        const key = `${Math.floor(target.x / near) + dx},${Math.floor(target.y / near) + dy}`;
        cells.set(key, [...(cells.get(key) ?? []), index]);
      }
    }
    return target;
  });
  const rows = new Set([...cells.keys()].map((key) => Number(key.split(",")[1])));
  const positions = splats.positions;
  for (let k = 0, i = 0; i < positions.length; k++, i += 3) {
    if (splats.opacities[k] < 0.3) continue;
    const [X, Y, Z] = [positions[i], positions[i + 1], positions[i + 2]];
    const z = R[6] * X + R[7] * Y + R[8] * Z + t[2];
    if (z <= 0) continue;
    const y = pose.fy * (R[3] * X + R[4] * Y + R[5] * Z + t[1]) / z + pose.cy;
    const row = Math.floor(y / near);
    if (!rows.has(row)) continue;
    const x = pose.fx * (R[0] * X + R[1] * Y + R[2] * Z + t[0]) / z + pose.cx;
    for (const index of cells.get(`${Math.floor(x / near)},${row}`) ?? []) {
      const target = targets[index];
      if (z < target.z && Math.hypot(x - target.x, y - target.y) < near
          && isShown(splats, k, shown)) target.before += splats.opacities[k];
    }
  }
  return targets.map(({ before }) => before > 3);
}

/**
 * @typedef {object} Place
 * @property {number[]} point in the world
 * @property {number[]} ray unit vector from the eye to it
 * @property {number} across standard deviation across the ray: of pointing
 * @property {number} along the same along the ray: of depth
 * @property {number} seen photographs that saw it (most of what is drawn there)
 * @property {number} jaw 0 neither, 1 upper, 2 lower
 */

/**
 * Pointing is good to so many pixels of the page, whatever the canvas has, and the depth of a
 * single photograph to this share of a pixel of its own, whatever the page shows.
 */
const POINTING = 1.5, LEAST_PARALLAX = 0.05;

/** How long a pixel of the photographs is at a place: the median of all. */
function photoPixel(views, point) {
  const lengths = views.map(({ rotation, translation, fx }) =>
    (dot(rotation.slice(6, 9), point) + translation[2]) / fx).sort((a, b) => a - b);
  return Math.max(0, lengths[lengths.length >> 1]);
}

/**
 * The place under a pixel, or null where the scene is more transparent than not.
 * @param {object} scene as the page holds it
 * @param {{pose: Pose, x: number, y: number, fine: number}} spot the size of the pose is in the
 *   pixels of x, y, of which there are so many to one of the page
 * @returns {?Place}
 */
function pick(splats, { format, views }, { pose, x, y, fine }, shown) {
  let light = 1, sum = 0, squares = 0;
  const seen = new Map(), jaws = [0, 0, 0];
  for (const { z, alpha, splat } of layersAt(splats, format, pose, x, y, shown)) {
    const weight = light * alpha;
    sum += weight * z;
    squares += weight * z * z;
    const by = seenBy(splats.flags[splat]);
    seen.set(by, (seen.get(by) ?? 0) + weight);
    jaws[jawOf(splats.flags[splat])] += weight;
    light *= 1 - alpha;
    if (light < 1e-4) break;
  }
  const opaque = 1 - light;
  if (opaque < 0.5) return null;
  const z = sum / opaque;
  const spread = Math.sqrt(Math.max(0, squares / opaque - z * z));
  const ray = [(x - pose.cx) / pose.fx, (y - pose.cy) / pose.fy, 1];
  const turn = transposed(pose.rotation);
  const most = [...seen].reduce((best, entry) => (entry[1] > best[1] ? entry : best), [0, -1])[0];
  const point = applied(turn, minus(scaled(ray, z), pose.translation));
  const alone = most < 2 && format.knowsSeen ? photoPixel(views, point) / LEAST_PARALLAX : 0;
  return {
    point,
    ray: unit(applied(turn, ray)),
    across: POINTING * fine * z / pose.fx,
    along: Math.max(spread, alone),
    seen: most,
    jaw: jaws.indexOf(Math.max(...jaws)),
  };
}
