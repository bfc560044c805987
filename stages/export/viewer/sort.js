// Depth order of the splats. The same text runs in a worker and, where there is none, in the page.

/**
 * Indices of the splats from the farthest to the nearest: two passes of a counting sort on the bits
 * of the depth (positive floats order as their bits do), exact and stable.
 *
 * @param {Float32Array} positions x, y, z of every splat, in the world
 * @param {number[]} axis third row of cam_from_world: depth = axis . (x, y, z, 1)
 * @returns {Uint32Array}
 */
function backToFront(positions, axis) {
  const count = positions.length / 3;
  const depth = new Float32Array(count);
  const bits = new Uint32Array(depth.buffer);
  for (let i = 0, k = 0; i < count; i++, k += 3) {
    const z = axis[0] * positions[k] + axis[1] * positions[k + 1] + axis[2] * positions[k + 2];
    depth[i] = Math.max(0, z + axis[3]);
    bits[i] = ~bits[i];
  }
  let order = new Uint32Array(count);
  let next = new Uint32Array(count);
  for (let i = 0; i < count; i++) order[i] = i;
  for (const shift of [0, 16]) {
    const start = new Uint32Array(65537);
    for (let i = 0; i < count; i++) start[((bits[i] >>> shift) & 65535) + 1]++;
    for (let key = 0; key < 65536; key++) start[key + 1] += start[key];
    for (let i = 0; i < count; i++) {
      const splat = order[i];
      next[start[(bits[splat] >>> shift) & 65535]++] = splat;
    }
    [order, next] = [next, order];
  }
  return order;
}

/** Sorts in a worker if the browser lets a page from disk have one, else at once. */
class Sorter {
  /** @param {Float32Array} positions @param {(order: Uint32Array) => void} deliver */
  constructor(positions, deliver) {
    this.positions = positions;
    this.deliver = deliver;
    this.busy = false;
    this.waiting = null;
    this.worker = null;
    try {
      const source = `"use strict"; ${backToFront}; let positions;
        onmessage = (event) => {
          if (event.data.positions) { positions = event.data.positions; return; }
          const order = backToFront(positions, event.data.axis);
          postMessage(order, [order.buffer]);
        };`;
      const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
      this.worker = new Worker(address);
      this.worker.onmessage = (event) => this.#finish(event.data);
      this.worker.onerror = (event) => { event.preventDefault(); this.#giveUp(); };
      this.worker.postMessage({ positions });
    } catch {
      this.worker = null;
    }
  }

  /** Ask for the order of a view; of several requests in a row only the last is served. */
  request(axis) {
    if (!this.worker) {
      this.deliver(backToFront(this.positions, axis));
    } else if (this.busy) {
      this.waiting = axis;
    } else {
      this.busy = true;
      this.current = axis;
      this.worker.postMessage({ axis });
    }
  }

  #finish(order) {
    this.busy = false;
    this.deliver(order);
    if (this.waiting) {
      const axis = this.waiting;
      this.waiting = null;
      this.request(axis);
    }
  }

  #giveUp() {
    this.worker = null;
    const axis = this.waiting ?? this.current;
    this.waiting = null;
    this.busy = false;
    if (axis) this.request(axis);
  }
}
