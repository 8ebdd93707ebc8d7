// The viewer's own camera: where it stands, how it turns around a point in front of it, and how it flies.

const CLOSEST = 0.01, NEARLY_VERTICAL = 0.995;

class View {
  constructor(model) {
    const ups = Array.from({ length: model.T }, (_, frame) => model.cameraAt(frame).rows[1].map((value) => -value));
    this.up = unit(ups.reduce((sum, up) => add(sum, up)));  // of the clip: yaw turns about it, so the horizon stays
    this.frame = { width: model.scene.width, height: model.scene.height };
    this.distance = 1;
  }

  stand({ centre, rows, lens }) {
    Object.assign(this, { centre: [...centre], rows: rows.map((row) => [...row]), lens: [...lens] });
  }

  get target() { return add(this.centre, this.rows[2], this.distance); }

  // Scale and margins with which the frame fits into a picture of width x height, in the middle.
  fit(width, height) {
    const scale = Math.min(width / this.frame.width, height / this.frame.height);
    const margins = [(width - scale * this.frame.width) / 2, (height - scale * this.frame.height) / 2];
    return { scale, margins };
  }

  // This camera for a picture of width x height; pixel centres are at integers.
  fitted(width, height) {
    const { scale, margins } = this.fit(width, height), [fx, fy, cx, cy] = this.lens;
    const lens = [scale * fx, scale * fy, scale * (cx + 0.5) - 0.5 + margins[0], scale * (cy + 0.5) - 0.5 + margins[1]];
    return { centre: this.centre, rows: this.rows, lens };
  }

  // Turn the axes by radians: yaw about the vertical of the clip, pitch about the own horizontal.
  turn(yaw, pitch) {
    const steep = dot(this.rows[2], this.up);
    if (Math.abs(steep) > NEARLY_VERTICAL && steep * pitch > 0) pitch = 0;
    const about = (axis, angle) => (v) => {
      const turned = add(v.map((value) => value * Math.cos(angle)), cross(axis, v), Math.sin(angle));
      return add(turned, axis, dot(axis, v) * (1 - Math.cos(angle)));
    };
    this.rows = this.rows.map(about(this.up, yaw));
    this.rows = this.rows.map(about(this.rows[0], pitch)).map(unit);
  }

  orbit(yaw, pitch) {
    const { target } = this;
    this.turn(yaw, pitch);
    this.centre = add(target, this.rows[2], -this.distance);
  }

  // Move with the picture: what lies at the distance of the target follows a drag by (dx, dy) px of a picture.
  pan(dx, dy, scale) {
    this.centre = add(this.centre, this.rows[0], (-dx * this.distance) / (scale * this.lens[0]));
    this.centre = add(this.centre, this.rows[1], (-dy * this.distance) / (scale * this.lens[1]));
  }

  zoom(factor) {
    const { target } = this;
    this.distance = Math.max(CLOSEST, this.distance * factor);
    this.centre = add(target, this.rows[2], -this.distance);
  }

  fly(right, down, ahead) {
    [right, down, ahead].forEach((step, k) => { this.centre = add(this.centre, this.rows[k], step); });
  }
}
