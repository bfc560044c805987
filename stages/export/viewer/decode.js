// Unpacks the arrays that compact.py packed, and lays the Gaussians out for the GPU.

/** @returns {Promise<Uint8Array>} what was deflated and put in base64 */
async function inflated(text) {
  if (typeof DecompressionStream === "undefined") {
    throw new Error("This browser is too old to unpack the scene.");
  }
  const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/**
 * The columns of all arrays as whole numbers.
 * @param {Uint8Array} bytes @param {Record<string, object>} arrays see `Pack` in compact.py
 * @returns {Record<string, Uint16Array[]>}
 */
function columnsOf(bytes, arrays) {
  const found = {};
  let at = 0;
  for (const [name, { rows, columns, bits, delta }] of Object.entries(arrays)) {
    found[name] = [];
    for (let c = 0; c < columns; c++) {
      const column = Uint16Array.from(bytes.subarray(at, at + rows));
      at += rows;
      if (bits > 8) {
        for (let k = 0; k < rows; k++) column[k] |= bytes[at + k] << 8;
        at += rows;
      }
      if (delta) undoDelta(column, (1 << bits) - 1);
      found[name].push(column);
    }
  }
  return found;
}

function undoDelta(column, mask) {
  let value = 0;
  for (let k = 0; k < column.length; k++) {
    const zigzag = column[k];
    value = (value + (zigzag & 1 ? -((zigzag + 1) >> 1) : zigzag >> 1)) & mask;
    column[k] = value;
  }
}

const floatBox = new Float32Array(1);
const bitBox = new Uint32Array(floatBox.buffer);

/** The bits of the nearest half float (small ones become 0). */
function half(value) {
  floatBox[0] = value;
  const bits = bitBox[0];
  const sign = (bits >>> 16) & 0x8000;
  const exponent = ((bits >>> 23) & 255) - 112;
  if (exponent <= 0) return sign;
  if (exponent >= 31) return sign | 0x7bff;
  return sign + ((exponent << 10) | ((bits >>> 13) & 1023)) + ((bits >>> 12) & 1);
}

/** All values that a column of an array can have, each passed through `change`. */
function levels({ bits, low, step }, column, change = (value) => value) {
  return Array.from({ length: 1 << bits }, (_, k) => change(low[column] + step[column] * k));
}

/** Directions [3] from octahedral coordinates. */
function fromOctahedral(x, y) {
  const z = 1 - Math.abs(x) - Math.abs(y);
  if (z >= 0) return unit([x, y, z]);
  return unit([
    (1 - Math.abs(y)) * (x >= 0 ? 1 : -1), (1 - Math.abs(x)) * (y >= 0 ? 1 : -1), z]);
}

function meansOf(columns, { low, step }, centre, reach, count) {
  const positions = new Float32Array(3 * count);
  for (let axis = 0; axis < 3; axis++) {
    for (let k = 0; k < count; k++) {
      const folded = low[axis] + step[axis] * columns[axis][k];
      positions[3 * k + axis] =
        centre[axis] + reach * Math.sign(folded) * Math.expm1(Math.abs(folded));
    }
  }
  return positions;
}

const CONSTANT_HARMONIC = 0.28209479177387814;

/**
 * @typedef {object} Splats
 * @property {Uint32Array} packed for the GPU, `texels` texels a splat:
 *   texel 0: mean x, y, z as floats, quaternion (see `packed_quaternions` in compact.py);
 *   texel 1 and on, halfs: log scale x, y, z, opacity, colour r, g, b, then the harmonics
 *   [coefficient][channel], or the normal where the scene has a light
 * @property {Float32Array} positions 3 each
 * @property {Float32Array} scales 3 each, not logarithms
 * @property {Float32Array} opacities
 * @property {Uint8Array} flags jaw and photographs, see compact.py
 * @property {?{vertices: Float32Array, jaws: Uint8Array, faces: Uint16Array}} mesh
 */

/** @returns {Promise<Splats>} */
async function unpacked(text, format) {
  const { arrays, centre, count, texels } = format;
  const columns = columnsOf(await inflated(text), arrays);
  const stride = 4 * texels;
  const packed = new Uint32Array(stride * count);
  const floats = new Float32Array(packed.buffer);
  const halfs = new Uint16Array(packed.buffer);
  const positions = meansOf(columns.means, arrays.means, centre, format.reach, count);
  for (let k = 0; k < count; k++) {
    floats.set(positions.subarray(3 * k, 3 * k + 3), stride * k);
    const [a, b, c, d] = columns.turns;
    packed[stride * k + 3] = a[k] | (b[k] << 8) | (c[k] << 16) | (d[k] << 24);
  }
  let place = 8;  // halfs after the mean and the quaternion
  const put = (name, change) => {
    for (let c = 0; c < arrays[name].columns; c++, place++) {
      const table = Uint16Array.from(levels(arrays[name], c, (value) => half(change(value))));
      const column = columns[name][c];
      for (let k = 0, at = place; k < count; k++, at += 2 * stride) halfs[at] = table[column[k]];
    }
  };
  put("scales", (value) => value);
  put("opacities", (value) => value);
  put("colours", format.light ? (albedo) => (albedo - 0.5) / CONSTANT_HARMONIC : (value) => value);
  if (arrays.harmonics) put("harmonics", (value) => value);
  if (arrays.normals) {
    const [x, y] = [0, 1].map((c) => levels(arrays.normals, c));
    const [us, vs] = columns.normals;
    for (let k = 0; k < count; k++) {
      const normal = fromOctahedral(x[us[k]], y[vs[k]]);
      for (let axis = 0; axis < 3; axis++) halfs[2 * stride * k + place + axis] = half(normal[axis]);
    }
  }
  return {
    packed, positions, scales: sizesOf(columns.scales, arrays.scales, count),
    opacities: Float32Array.from(
      columns.opacities[0], (level) => arrays.opacities.low[0] + arrays.opacities.step[0] * level),
    flags: Uint8Array.from(columns.flags[0]),
    mesh: arrays.mesh_vertices ? meshOf(columns, arrays) : null,
  };
}

function sizesOf(columns, array, count) {
  const scales = new Float32Array(3 * count);
  for (let axis = 0; axis < 3; axis++) {
    const table = levels(array, axis, Math.exp);
    for (let k = 0; k < count; k++) scales[3 * k + axis] = table[columns[axis][k]];
  }
  return scales;
}

function meshOf(columns, arrays) {
  const { rows, low, step } = arrays.mesh_vertices;
  const vertices = new Float32Array(3 * rows);
  for (let axis = 0; axis < 3; axis++) {
    for (let k = 0; k < rows; k++) {
      vertices[3 * k + axis] = low[axis] + step[axis] * columns.mesh_vertices[axis][k];
    }
  }
  const [first] = columns.mesh_first;
  const [second, third] = columns.mesh_others;
  const faces = new Uint16Array(3 * first.length);
  for (let k = 0; k < first.length; k++) {
    faces.set([first[k], first[k] + second[k], first[k] + third[k]], 3 * k);
  }
  return { vertices, jaws: Uint8Array.from(columns.mesh_jaws[0]), faces };
}
