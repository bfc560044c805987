// Camera geometry. Matrices are 9 numbers, row-major; OpenCV axes (x right, y down, z forward).

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const mix = (a, b, share) => a + (b - a) * share;

const applied = (R, p) => [dot(R.slice(0, 3), p), dot(R.slice(3, 6), p), dot(R.slice(6, 9), p)];
const transposed = (R) => [R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]];
const centreOf = (R, t) => scaled(applied(transposed(R), t), -1);

function product(A, B) {
  const columns = transposed(B);
  return [0, 3, 6].flatMap((r) => applied(columns, A.slice(r, r + 3)));
}

/** Rotation by `angle` radians about a unit axis (Rodrigues). */
function turned(axis, angle) {
  const [x, y, z] = axis;
  const s = Math.sin(angle), c = Math.cos(angle), k = 1 - c;
  return [
    c + x * x * k, x * y * k - z * s, x * z * k + y * s,
    y * x * k + z * s, c + y * y * k, y * z * k - x * s,
    z * x * k - y * s, z * y * k + x * s, c + z * z * k];
}

/** Axis (unit) and angle of a rotation matrix. */
function axisAngle(R) {
  const angle = Math.acos(clamp((R[0] + R[4] + R[8] - 1) / 2, -1, 1));
  const axis = [R[7] - R[5], R[2] - R[6], R[3] - R[1]];
  if (Math.hypot(...axis) > 1e-9) return [unit(axis), angle];
  if (angle < 1) return [[0, 0, 1], 0];
  const k = [R[0], R[4], R[8]].indexOf(Math.max(R[0], R[4], R[8]));  // half a turn
  const column = [R[k], R[3 + k], R[6 + k]];
  column[k] += 1;
  return [unit(column), angle];
}

/** Gram-Schmidt: keeps a product of many small rotations a rotation. */
function orthonormal(R) {
  const z = unit(R.slice(6, 9));
  const x = unit(minus(R.slice(0, 3), scaled(z, dot(R.slice(0, 3), z))));
  return [...x, ...cross(z, x), ...z];
}

/**
 * The same camera in another frame, where points are scale * rotation * x + translation.
 * @param {Pose} pose @param {{rotation: number[], translation: number[], scale: number}} similarity
 */
function carried(pose, { rotation: turn, translation: shift, scale }) {
  const rotation = product(pose.rotation, transposed(turn));
  const translation = minus(scaled(pose.translation, scale), applied(rotation, shift));
  return { ...pose, rotation, translation };
}

/** The pose that shows the mirror image's place: reflected in a plane through `point`. */
function mirrored(pose, point, normal) {
  const over = (vector) => minus(vector, scaled(normal, 2 * dot(vector, normal)));
  const { rotation: R, translation: t } = pose;
  const eye = plus(point, over(minus(centreOf(R, t), point)));
  const rotation = [
    ...scaled(over(R.slice(0, 3)), -1), ...over(R.slice(3, 6)), ...over(R.slice(6, 9))];
  return {
    ...pose, rotation, translation: scaled(applied(rotation, eye), -1), cx: pose.width - pose.cx,
  };
}

/** Turned by so much (radians), a tilted camera has lost two thirds of its tilt. */
const LEVEL_AFTER = 0.15;

/**
 * A camera that looks at a target on its optical axis, and moves about it within limits.
 *
 * Every pose can be written this way, so the poses of the photographs are reached exactly.
 */
class OrbitCamera {
  /**
   * @param {{up: number[], front: number[], centre: number[], radius: number, limits: object}}
   *   orbiting up and front are unit vectors at right angles; angles in the limits are in radians
   */
  constructor(orbiting) {
    this.orbiting = orbiting;
    this.side = cross(orbiting.up, orbiting.front);
    this.rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1];
    this.target = [...orbiting.centre];
    this.distance = 3 * orbiting.radius;
    this.lens = { fx: 1, fy: 1, cx: 0.5, cy: 0.5, width: 1, height: 1 };
  }

  /** @param {Pose} pose */
  place(pose) {
    const { rotation, translation, ...lens } = pose;
    this.rotation = [...rotation];
    const eye = centreOf(rotation, translation);
    const forward = rotation.slice(6, 9);
    const ahead = dot(minus(this.orbiting.centre, eye), forward);
    this.distance = Math.max(ahead, 0.05 * this.orbiting.radius);
    this.target = plus(eye, scaled(forward, this.distance));
    this.lens = lens;
  }

  /** @returns {Pose} */
  pose() {
    const translation = minus([0, 0, this.distance], applied(this.rotation, this.target));
    return { rotation: this.rotation, translation, ...this.lens };
  }

  snapshot() {
    return {
      rotation: [...this.rotation], target: [...this.target], distance: this.distance,
      lens: { ...this.lens },
    };
  }

  /** Set the camera to a blend of two snapshots; the rotation goes the short way at even speed. */
  blend(from, to, share) {
    const [axis, angle] = axisAngle(product(to.rotation, transposed(from.rotation)));
    this.rotation = product(turned(axis, angle * share), from.rotation);
    this.target = from.target.map((value, k) => mix(value, to.target[k], share));
    this.distance = from.distance * (to.distance / from.distance) ** share;
    this.lens = Object.fromEntries(
      Object.keys(to.lens).map((key) => [key, mix(from.lens[key], to.lens[key], share)]));
  }

  /** Where the camera stands as seen from the target: radians about `up` and above the horizon. */
  angles() {
    const away = scaled(this.rotation.slice(6, 9), -1);
    return {
      azimuth: Math.atan2(dot(away, this.side), dot(away, this.orbiting.front)),
      elevation: Math.asin(clamp(dot(away, this.orbiting.up), -1, 1)),
    };
  }

  /** Turn about the target; a limit never pulls a camera that a photograph put beyond it. */
  orbit(byAzimuth, byElevation) {
    const { azimuth, elevation } = this.angles();
    const { azimuth: range, elevation: rise } = this.orbiting.limits;
    const go = (now, by, [low, high]) =>
      clamp(now + by, Math.min(low, now), Math.max(high, now)) - now;
    const turn = range ? go(azimuth, byAzimuth, range) : byAzimuth;
    const lift = go(elevation, byElevation, rise);
    const away = scaled(this.rotation.slice(6, 9), -1);
    const level = cross(away, this.orbiting.up);
    let world = turned(this.orbiting.up, turn);
    if (Math.hypot(...level) > 1e-6) world = product(world, turned(unit(level), lift));
    this.rotation = orthonormal(product(this.rotation, transposed(world)));
    this.#level(Math.abs(turn) + Math.abs(lift));
  }

  /** Right the horizon, the more the further the camera was turned: photographs are tilted. */
  #level(turn) {
    const [right, down, forward] = [0, 3, 6].map((k) => this.rotation.slice(k, k + 3));
    const level = cross(forward, this.orbiting.up);
    if (Math.hypot(...level) < 0.2) return;  // from above or below nothing is level
    const across = unit(level);
    const tilt = Math.atan2(dot(down, across), dot(right, across));
    const by = tilt * (1 - Math.exp(-turn / LEVEL_AFTER));
    this.rotation = [
      ...plus(scaled(right, Math.cos(by)), scaled(down, Math.sin(by))),
      ...plus(scaled(down, Math.cos(by)), scaled(right, -Math.sin(by))), ...forward];
  }

  zoom(factor) {
    const { distance: [near, far] } = this.orbiting.limits;
    const now = this.distance;
    this.distance = clamp(now * factor, Math.min(near, now), Math.max(far, now));
  }

  /** Move sideways by a share of the picture's focal length (pixels / fx, pixels / fy). */
  pan(x, y) {
    const shift = applied(transposed(this.rotation), [-x * this.distance, -y * this.distance, 0]);
    const from = minus(plus(this.target, shift), this.orbiting.centre);
    const most = this.orbiting.limits.pan;
    const length = Math.hypot(...from);
    this.target = plus(this.orbiting.centre, length > most ? scaled(from, most / length) : from);
  }

  /**
   * The same camera for a canvas: the photograph's frame fits inside, centred in what is left by a
   * strip at the bottom and one at the right that the controls cover.
   */
  fitted(width, height, strip = 0, side = 0) {
    const pose = this.pose();
    const scale = Math.min((width - side) / pose.width, (height - strip) / pose.height);
    const left = (width - side - pose.width * scale) / 2;
    const top = (height - strip - pose.height * scale) / 2;
    return {
      ...pose, width, height, fx: pose.fx * scale, fy: pose.fy * scale,
      cx: pose.cx * scale + left, cy: pose.cy * scale + top,
      frame: { left, top, width: pose.width * scale, height: pose.height * scale },
    };
  }
}
