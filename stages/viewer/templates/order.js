// The order of drawing: all Gaussians in front of the camera that are there at the time, nearest first. No worker does
// this: two passes of counting take 1 to 2 ms for 50 000 Gaussians, and so the order is always that of the picture.

// Largest (time from the birth / span)^2 / 2 at which a Gaussian may be drawn: exp(-GONE) is the least alpha, 1/255.
const GONE = Math.log(255);

class DrawingOrder {
  constructor(model) {
    this.model = model;
    this.depths = new Float32Array(model.N);
    this.bits = new Uint32Array(this.depths.buffer);  // positive floats are ordered as their bits
    this.chosen = new Uint32Array(model.N);
    this.sorted = new Uint32Array(model.N);
    this.counts = new Uint32Array(65536);
    this.planes = new Float32Array(4 * model.P);
  }

  // Depth is linear in the canonical mean: of a static Gaussian it is ahead . mean + shift, of a dynamic one the
  // weighted sum of one such plane per control point.
  measure(view, motion, time, near, shown) {
    const { model, depths, chosen, planes } = this, { means, index, weights, points, lives } = model.arrays;
    const [a, b, c] = view.rows[2], shift = -dot(view.rows[2], view.centre), first = model.scene.static;
    let n = 0;
    if (shown.static) {
      for (let i = 0; i < first; i++) {
        const depth = a * means[3 * i] + b * means[3 * i + 1] + c * means[3 * i + 2] + shift;
        depths[i] = depth;
        if (depth > near) chosen[n++] = i;
      }
    }
    if (!shown.dynamic) return n;
    for (let p = 0; p < model.P; p++) this.plane(p, [a, b, c], shift, motion, points);
    const K = model.pairs;
    for (let i = first; i < model.N; i++) {
      const life = 2 * (i - first), away = (time - lives[life]) * lives[life + 1];
      if (away * away > GONE) continue;
      const from = 3 * i, by = 3 * (i - first), { drifts } = model;
      const x = means[from] + away * drifts[by], y = means[from + 1] + away * drifts[by + 1];
      const z = means[from + 2] + away * drifts[by + 2];
      let depth = 0;
      for (let k = 0, pair = K * (i - first); k < K; k++, pair++) {
        const at = 4 * index[pair];
        depth += weights[pair] * (planes[at] * x + planes[at + 1] * y + planes[at + 2] * z + planes[at + 3]);
      }
      depths[i] = depth / 255;
      if (depths[i] > near) chosen[n++] = i;
    }
    return n;
  }

  // The depth of what control point p alone would move: `ahead` turned back by its rotation, and a constant.
  plane(p, ahead, shift, motion, points) {
    const at = 12 * p, back = [-motion[at + 1], -motion[at + 2], -motion[at + 3]], w = motion[at];
    const t = cross(back, ahead).map((value) => 2 * value);
    const turned = add(add(ahead, t, w), cross(back, t));
    const point = [points[3 * p], points[3 * p + 1], points[3 * p + 2]];
    const there = add(point, [motion[at + 4], motion[at + 5], motion[at + 6]]);
    this.planes.set([...turned, dot(ahead, there) - dot(turned, point) + shift], 4 * p);
  }

  // Indices of the Gaussians to draw, nearest first, equal depths by index. Reused by the next call.
  sort(view, motion, time, near, shown) {
    const n = this.measure(view, motion, time, near, shown);
    this.pass(this.chosen, this.sorted, n, 0);
    this.pass(this.sorted, this.chosen, n, 16);
    return this.chosen.subarray(0, n);
  }

  pass(from, to, n, digit) {
    const { counts, bits } = this;
    counts.fill(0);
    for (let k = 0; k < n; k++) counts[(bits[from[k]] >>> digit) & 65535]++;
    for (let value = 0, before = 0; value < 65536; value++) {
      const count = counts[value];
      counts[value] = before;
      before += count;
    }
    for (let k = 0; k < n; k++) to[counts[(bits[from[k]] >>> digit) & 65535]++] = from[k];
  }
}
