// Draws the model: projects its Gaussians in drawing order, blends them front to back, resolves to the canvas.

const SPLAT_FLOATS = 12;
const MODES = { colour: 0, depth: 1, instances: 2 };

class SplatRenderer {
  constructor(gl, model) {
    Object.assign(this, { gl, model, order: new DrawingOrder(model), target: new Target(gl) });
    const { arrays } = model, captured = ["splat_centre", "splat_shape", "splat_colour"];
    this.projection = makeProgram(gl, "project.vert", null, captured);
    this.drawing = makeProgram(gl, "splat.vert", "splat.frag");
    this.resolving = makeProgram(gl, "resolve.vert", "resolve.frag");
    const formats = {
      means: "RGB32F", quats: "RGBA16F", shapes: "RGBA16F", sh_dc: "RGB16F", sh_rest: "RGB8_SNORM", index: "R16UI",
      weights: "R8", lives: "RG32F", drifts: "RGB16F", instances: "R8UI", points: "RGB32F",
    };
    this.data = {};
    for (const [name, format] of Object.entries(formats)) this.data[name] = makeData(gl, format, arrays[name]);
    this.data.motions = makeData(gl, "RGBA32F", model.present);
    this.data.shade = makeData(gl, "RGB32F", model.shade);
    this.prepareBuffers();
    this.setConstants();
  }

  prepareBuffers() {
    const { gl, model } = this;
    this.indices = gl.createBuffer();
    this.ordered = gl.createVertexArray();
    gl.bindVertexArray(this.ordered);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * model.N, gl.DYNAMIC_DRAW);
    const place = this.projection.attribute("gaussian");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribIPointer(place, 1, gl.UNSIGNED_INT, 4, 0);

    // Projected splats go from the buffer to a texture, and all corners are drawn as one list of triangles: with an
    // instance per splat a software renderer takes six times as long (1.06 s of CPU for 48 563 splats, not 0.17).
    this.projected = gl.createBuffer();
    this.splats = makeData(gl, "RGBA32F", new Float32Array(SPLAT_FLOATS * model.N));
    gl.bindBuffer(gl.ARRAY_BUFFER, this.projected);
    gl.bufferData(gl.ARRAY_BUFFER, this.splats.bytes, gl.DYNAMIC_COPY);
    this.corners = gl.createVertexArray();
    gl.bindVertexArray(this.corners);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const quad = [0, 1, 2, 2, 1, 3];
    const triangles = Uint32Array.from({ length: 6 * model.N }, (_, k) => 4 * Math.floor(k / 6) + quad[k % 6]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    this.feedback = gl.createTransformFeedback();
    this.empty = gl.createVertexArray();
  }

  setConstants() {
    const { gl, model } = this, { scene } = model, { program, uniforms } = this.projection;
    gl.useProgram(program);
    gl.uniform1i(uniforms.n_static, scene.static);
    gl.uniform1i(uniforms.n_lit, scene.static - model.B);
    gl.uniform1i(uniforms.pairs, model.pairs);
    gl.uniform1i(uniforms.sh_degree, scene.sh_degree);
    gl.uniform1f(uniforms.near, scene.near);
    gl.uniform1f(uniforms.extinction, scene.extinction);
    gl.uniform3fv(uniforms.airlight, scene.airlight);
    const steps = new Float32Array(45);
    steps.set(scene.sh_steps);
    gl.uniform3fv(uniforms.sh_steps, steps);
    Object.keys(this.data).forEach((name, k) => gl.uniform1i(uniforms[name], k));
    gl.useProgram(this.resolving.program);
    gl.uniform3fv(this.resolving.uniforms.background, scene.background);
  }

  // Draw into the canvas. view: centre, rows, lens in px of a picture of `width` x `height`, which the target gets too;
  // `scale`: pixels of it per pixel of the frame. time in frames. shown: { static, dynamic }. mode: one of MODES.
  draw(view, { time, width, height, scale, shown, mode, range }) {
    this.drawTarget(view, { time, width, height, scale, shown, mode });
    const { gl } = this, { program, uniforms } = this.resolving;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(uniforms.mode, MODES[mode]);
    gl.uniform2fv(uniforms.range, range);
    gl.uniform3fv(uniforms.gain, this.model.gainAt(time));
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  drawTarget(view, { time, width, height, scale, shown, mode }) {
    const { gl, model } = this, { scene } = model, motion = model.motionAt(time);
    const order = this.order.sort(view, motion, time, scene.near, shown);
    this.data.motions.update(motion);
    this.data.shade.update(model.shadeAt(time));
    this.project(view, order, time, width, height, scene.blur * Math.max(1, scale * scale), mode);
    this.target.resize(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.useProgram(this.drawing.program);
    gl.uniform2f(this.drawing.uniforms.size, width, height);
    gl.activeTexture(gl.TEXTURE0);
    this.splats.copy(this.projected, SPLAT_FLOATS * order.length);
    gl.bindVertexArray(this.corners);
    gl.drawElements(gl.TRIANGLES, 6 * order.length, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }

  // Fill the buffer of splats. The blur of the projection is in pixels of the frame, so it grows with the picture: the
  // scene looks as it was trained at any size of the window.
  project(view, order, time, width, height, blur, mode) {
    const { gl } = this, { program, uniforms } = this.projection;
    gl.useProgram(program);
    gl.uniform3fv(uniforms.eye, view.centre);
    ["right", "down", "ahead"].forEach((name, k) => gl.uniform3fv(uniforms[name], view.rows[k]));
    gl.uniform4fv(uniforms.lens, view.lens);
    gl.uniform2f(uniforms.size, width, height);
    gl.uniform1f(uniforms.blur, blur);
    gl.uniform1f(uniforms.time, time);
    gl.uniform1i(uniforms.mode, MODES[mode]);
    Object.values(this.data).forEach(({ texture }, k) => {
      gl.activeTexture(gl.TEXTURE0 + k);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    gl.bindVertexArray(this.ordered);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.projected);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, order.length);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
  }

  // Depth of the scene at pixel (x, y) of the canvas' picture; null where nothing is.
  depthAt(view, options, x, y) {
    this.drawTarget(view, { ...options, mode: "depth" });
    const { gl } = this, sum = new Float32Array(4);
    if (this.target.internal !== gl.RGBA16F) return null;
    gl.readPixels(Math.round(x), options.height - 1 - Math.round(y), 1, 1, gl.RGBA, gl.FLOAT, sum);
    return sum[3] > 0.3 ? sum[3] / sum[0] : null;
  }

  // Inverse depths [dark, bright] that leave out the farthest and the nearest 2 % of the Gaussians in front of a view.
  depthRange(view, time) {
    const everything = { static: true, dynamic: true };
    const order = this.order.sort(view, this.model.motionAt(time), time, this.model.scene.near, everything);
    const inverse = (share) => 1 / this.order.depths[order[Math.floor(share * (order.length - 1))]];
    return order.length ? [inverse(0.98), inverse(0.02)] : [0, 1];
  }
}
