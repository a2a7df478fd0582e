// Poses and the plane that the place is looked at from above. Worlds differ in which axis points up: it is the one that
// the cameras agree on. Camera axes: x right, y down, z forward. Quaternions are x, y, z, w.

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, by) => a.map((x) => x * by);
const added = (...all) => all.reduce((a, b) => a.map((x, axis) => x + b[axis]));
const unit = (a) => scaled(a, 1 / Math.hypot(...a));

export function rotate([x, y, z, w], v) {
  const q = [x, y, z];
  const t = scaled(cross(q, v), 2);
  return added(v, scaled(t, w), cross(q, t));
}

/** Of the matrix with these columns. */
function quaternion(right, down, forward) {
  const [m00, m10, m20] = right;
  const [m01, m11, m21] = down;
  const [m02, m12, m22] = forward;
  const trace = m00 + m11 + m22;
  let q;
  if (trace > 0) q = [m21 - m12, m02 - m20, m10 - m01, 1 + trace];
  else if (m00 > m11 && m00 > m22) q = [1 + m00 - m11 - m22, m01 + m10, m02 + m20, m21 - m12];
  else if (m11 > m22) q = [m01 + m10, 1 + m11 - m00 - m22, m12 + m21, m02 - m20];
  else q = [m02 + m20, m12 + m21, 1 + m22 - m00 - m11, m10 - m01];
  return unit(q);
}

const AXES = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];

/** A world seen from above: two axes to the right and to the top of the map, and up towards whoever looks. */
export class Plane {
  constructor(up_axis, sign) {
    this.up = scaled(AXES[up_axis], sign);
    const [a, b] = sign > 0 ? [(up_axis + 1) % 3, (up_axis + 2) % 3] : [(up_axis + 2) % 3, (up_axis + 1) % 3];
    this.right = AXES[a];
    this.top = AXES[b];
    this.names = { right: "xyz"[a], top: "xyz"[b] };
  }

  /** The plane whose up the cameras' upper edges point to. */
  static of(orientations) {
    const sum = added([0, 0, 0], ...orientations.map((orientation) => rotate(orientation, [0, -1, 0])));
    const axis = [0, 1, 2].reduce((best, axis) => (Math.abs(sum[axis]) > Math.abs(sum[best]) ? axis : best), 2);
    return new Plane(axis, sum[axis] < 0 ? -1 : 1);
  }

  is(other) {
    return other !== null && this.up.every((x, axis) => x === other.up[axis]);
  }

  /** Point on the map, metres, and height. */
  flat(point) {
    return { right: dot(point, this.right), top: dot(point, this.top), height: dot(point, this.up) };
  }

  /** Where it stands and looks, radians: heading from the map's right towards its top, pitch up. */
  stance({ position, orientation }) {
    const forward = rotate(orientation, [0, 0, 1]);
    const { right, top, height } = this.flat(forward);
    return {
      ...this.flat(position),
      heading: Math.atan2(top, right),
      pitch: Math.asin(Math.max(-1, Math.min(1, height))),
    };
  }

  /** The pose of an upright camera. */
  pose({ right, top, height, heading, pitch }) {
    const ahead = added(scaled(this.right, Math.cos(heading)), scaled(this.top, Math.sin(heading)));
    const forward = added(scaled(ahead, Math.cos(pitch)), scaled(this.up, Math.sin(pitch)));
    // Of the heading alone: it is there also where the camera looks straight up or down.
    const rightwards = cross(ahead, this.up);
    const down = cross(forward, rightwards);
    return {
      position: added(scaled(this.right, right), scaled(this.top, top), scaled(this.up, height)),
      orientation: quaternion(rightwards, down, forward),
    };
  }
}
