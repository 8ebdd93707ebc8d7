// What is drawn over the splats: the camera path, frustums, control points and their trajectories.

const PATH_TINT = [1, 0.85, 0.2, 1], NOW_TINT = [1, 0.35, 0.1, 1], POINT_TINT = [0.3, 1, 0.9, 1];
const FRUSTUM_DEPTH = 0.06;  // in units of the model, the median distance of what it shows

class LineRenderer {
  constructor(gl, model) {
    Object.assign(this, { gl, model, drawing: makeProgram(gl, "line.vert", "line.frag") });
    this.vertices = gl.createVertexArray();
    this.buffer = gl.createBuffer();
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    [["position", 3, 0], ["tint", 4, 12]].forEach(([name, size, offset]) => {
      const place = this.drawing.attribute(name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 28, offset);
    });
    gl.bindVertexArray(null);
    this.cameras = Array.from({ length: model.T }, (_, frame) => model.cameraAt(frame));
    this.tracks = this.trajectories();
  }

  draw(view, { time, width, height, show, ratio }) {
    const { gl, model } = this, { program, uniforms } = this.drawing;
    gl.useProgram(program);
    gl.uniform3fv(uniforms.eye, view.centre);
    ["right", "down", "ahead"].forEach((name, k) => gl.uniform3fv(uniforms[name], view.rows[k]));
    gl.uniform4fv(uniforms.lens, view.lens);
    gl.uniform2f(uniforms.size, width, height);
    gl.uniform1f(uniforms.near, model.scene.near);
    gl.uniform1f(uniforms.point_px, 5 * ratio);
    gl.bindVertexArray(this.vertices);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    if (show.trajectories) this.put(gl.LINES, this.tracks);
    if (show.points) this.put(gl.POINTS, this.controlPoints());
    if (show.path) this.put(gl.LINE_STRIP, this.cameras.flatMap(({ centre }) => [...centre, ...PATH_TINT]));
    if (show.frustums) this.put(gl.LINES, this.frustums(view, time));
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }

  // Draw vertices of seven numbers: position and tint.
  put(kind, vertices) {
    const { gl } = this, values = vertices instanceof Float32Array ? vertices : new Float32Array(vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    gl.drawArrays(kind, 0, values.length / 7);
  }

  // Every camera as a pyramid over its picture, but for the one that stands where the viewer does.
  frustums(view, time) {
    const vertices = [], { width, height } = this.model.scene;
    this.cameras.forEach(({ centre, rows, lens }, frame) => {
      if (Math.hypot(...add(centre, view.centre, -1)) < FRUSTUM_DEPTH / 2) return;
      const corners = [[0, 0], [width, 0], [width, height], [0, height]].map(([x, y]) => {
        const slopes = [(x - 0.5 - lens[2]) / lens[0], (y - 0.5 - lens[3]) / lens[1], 1];
        return slopes.reduce((sum, slope, k) => add(sum, rows[k], FRUSTUM_DEPTH * slope), centre);
      });
      const tint = frame === Math.round(time) ? NOW_TINT : [...PATH_TINT.slice(0, 3), 0.5];
      corners.forEach((corner, k) => {
        for (const end of [centre, corners[(k + 1) % 4]]) vertices.push(...corner, ...tint, ...end, ...tint);
      });
    });
    return vertices;
  }

  // The control points at the time for which the motions were last made.
  controlPoints() {
    const { points } = this.model.arrays, motion = this.model.present, vertices = [];
    for (let p = 0; p < this.model.P; p++) {
      for (let k = 0; k < 3; k++) vertices.push(points[3 * p + k] + motion[12 * p + 4 + k]);
      vertices.push(...POINT_TINT);
    }
    return vertices;
  }

  // A line from moment to moment for every control point, from blue in the first to red in the last one.
  trajectories() {
    const { P, R, motions, arrays: { points } } = this.model, vertices = new Float32Array(14 * P * Math.max(R - 1, 0));
    let at = 0;
    for (let p = 0; p < P; p++) {
      for (let moment = 0; moment + 1 < R; moment++) {
        for (const end of [moment, moment + 1]) {
          const share = end / (R - 1), from = 10 * (end * P + p) + 4;
          for (let k = 0; k < 3; k++) vertices[at++] = points[3 * p + k] + motions[from + k];
          vertices.set([share, 0.35, 1 - share, 0.6], at);
          at += 4;
        }
      }
    }
    return vertices;
  }
}
