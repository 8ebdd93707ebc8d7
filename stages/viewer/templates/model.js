// The model: arrays out of the page (stages/viewer/packing.py documents them), and what it is at a time between frames.
// Times are in frames, 0 .. T - 1. Lengths are in the unit of the packed model.

const ARRAY_TYPES = {
  float32: Float32Array, float16: Uint16Array, uint16: Uint16Array, uint8: Uint8Array, int8: Int8Array,
};

function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

function halfToFloat(half) {
  const sign = half & 0x8000 ? -1 : 1, exponent = (half >> 10) & 31, fraction = half & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  return exponent === 31 ? sign * (fraction ? NaN : Infinity) : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

class Model {
  constructor(scene, base64) {
    const { buffer } = bytesOf(base64);
    this.scene = scene;
    this.arrays = {};
    for (const [name, { type, shape, at }] of Object.entries(scene.arrays)) {
      this.arrays[name] = new ARRAY_TYPES[type](buffer, at, shape.reduce((a, b) => a * b, 1));
    }
    this.N = scene.arrays.means.shape[0];
    this.T = scene.frames.length;
    this.P = scene.arrays.points.shape[0];
    this.R = scene.arrays.motions.shape[0];  // moments at which motions are known, evenly spread over the frames
    this.pairs = scene.arrays.index.shape[1];
    const table = Float32Array.from({ length: 65536 }, (_, half) => halfToFloat(half));
    this.motions = Float32Array.from(this.arrays.motions, (half) => table[half]);
    this.drifts = Float32Array.from(this.arrays.drifts, (half) => table[half]);
    this.present = new Float32Array(12 * this.P);
    [this.Q, this.B] = scene.arrays.shadows.shape;  // moments, and Gaussians under moving shadows
    this.shade = new Float32Array(3 * this.B);
  }

  // Moments, of R, around a time with their weights in the cubic that passes through every moment (Catmull-Rom); at
  // either end as if one more followed along a line, so that what changes evenly does so up to the end.
  around(time, R) {
    const at = R === this.T ? time : time * (R - 1) / Math.max(this.T - 1, 1);
    const first = Math.min(Math.max(Math.floor(at), 0), R - 1), x = Math.min(Math.max(at - first, 0), 1);
    const weights = [
      -0.5 * x + x * x - 0.5 * x ** 3, 1 - 2.5 * x * x + 1.5 * x ** 3,
      0.5 * x + 2 * x * x - 1.5 * x ** 3, -0.5 * x * x + 0.5 * x ** 3,
    ];
    const found = [];
    weights.forEach((weight, k) => {
      const moment = first - 1 + k, there = Math.min(Math.max(moment, 0), R - 1);
      if (weight !== 0) found.push([there, moment === there ? weight : 2 * weight]);
      if (weight !== 0 && moment !== there) found.push([2 * there - moment, -weight]);
    });
    return found;
  }

  // Motions [P, 12] of the control points: quaternion, translation, -, colour offset, -. Reused by the next call.
  motionAt(time) {
    const { present, motions, P } = this, target = [0, 1, 2, 3, 4, 5, 6, 8, 9, 10];
    present.fill(0);
    for (const [moment, weight] of this.around(time, this.R)) {
      for (let p = 0; p < P; p++) {
        const from = 10 * (moment * P + p), to = 12 * p;
        for (let k = 0; k < 10; k++) present[to + target[k]] += weight * motions[from + k];
      }
    }
    for (let p = 0; p < P; p++) {
      const at = 12 * p, length = Math.hypot(present[at], present[at + 1], present[at + 2], present[at + 3]);
      for (let k = 0; k < 4; k++) present[at + k] /= length;
    }
    return present;
  }

  // What moving shadows add to the constant coefficients [B, 3]. Reused by the next call.
  shadeAt(time) {
    const { shade, B, arrays: { shadows, shadow_colours: colours } } = this, moments = this.around(time, this.Q);
    for (let b = 0; b < B; b++) {
      let amount = 0;
      for (const [moment, weight] of moments) amount += weight * shadows[B * moment + b];
      for (let k = 3 * b; k < 3 * b + 3; k++) shade[k] = amount * this.scene.shadow_step * colours[k] / 127 ** 2;
    }
    return shade;
  }

  // Rows [n] of an array [T, n] at a time, linear between frames.
  between(name, n, time) {
    const first = Math.min(Math.floor(time), this.T - 1), second = Math.min(first + 1, this.T - 1), x = time - first;
    const rows = this.arrays[name];
    return Array.from({ length: n }, (_, k) => (1 - x) * rows[n * first + k] + x * rows[n * second + k]);
  }

  // Exposure gains [3], as stages/splatting/gains.py: their logarithms are linear in time.
  gainAt(time) {
    const first = Math.min(Math.floor(time), this.T - 1), second = Math.min(first + 1, this.T - 1), x = time - first;
    const { gains } = this.arrays;
    return [0, 1, 2].map((c) => gains[3 * first + c] ** (1 - x) * gains[3 * second + c] ** x);
  }

  // The camera of the clip at a time: its centre, the rows of its rotation, and its lens [fx, fy, cx, cy].
  cameraAt(time) {
    const pose = this.between("poses", 12, time), nearest = this.arrays.poses.subarray(12 * Math.round(time));
    const exact = Number.isInteger(time) ? nearest : pose;
    const ahead = unit([exact[8], exact[9], exact[10]]);
    let right = [exact[0], exact[1], exact[2]];
    right = unit(add(right, ahead, -dot(right, ahead)));
    const rows = [right, cross(ahead, right), ahead];
    const centre = (shift, axes) => [0, 1, 2].map((k) => -axes.reduce((sum, axis, r) => sum + axis[k] * shift[r], 0));
    return { rows, centre: centre([exact[3], exact[7], exact[11]], rows), lens: this.between("lenses", 4, time) };
  }
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, scale = 1) => [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / Math.hypot(...a));
