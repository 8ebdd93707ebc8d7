// The application: its state, the loop that draws when something has changed, and what controls may ask of it.

const FRAMES_PER_SECOND = 12, SLOW_MS = 40, QUICK_MS = 20, COARSEST = 0.35, SETTLED_MS = 250;

class App {
  constructor(model, pictures, canvas, gl) {
    Object.assign(this, { model, pictures, canvas, gl, view: new View(model) });
    this.splats = new SplatRenderer(gl, model);
    this.lines = new LineRenderer(gl, model);
    this.still = matchMedia("(prefers-reduced-motion: reduce)");
    this.state = {
      time: 0, playing: false, loop: true, speed: 1, follow: true, mode: "colour", split: false, splitAt: 0.5,
      static: true, dynamic: true, points: false, trajectories: false, path: false, frustums: false,
    };
    this.quality = 1;  // share of the resolution that is drawn while things move
    this.range = this.splats.depthRange(model.cameraAt(0), 0);
    this.view.stand(model.cameraAt(0));
    const [, , cx, cy] = this.view.lens;  // what lies there is on the axis about which the camera orbits
    this.view.distance = this.splats.depthAt(this.view, this.plain(this.view.frame), cx, cy) ?? 1;
    this.panel = new Panel(this);
    this.flyBy = listenToKeys(this);
    listenToPointers(this, canvas);
    new ResizeObserver(() => this.redraw()).observe(canvas);
    this.play(!this.still.matches && model.T > 1);
  }

  cssSize() { return { width: this.canvas.clientWidth, height: this.canvas.clientHeight }; }
  cssScale() { return this.view.fit(this.canvas.clientWidth, this.canvas.clientHeight).scale; }
  plain({ width, height }) { return { time: this.state.time, width, height, scale: 1, shown: this.state }; }

  redraw() {
    this.changed = true;
    this.asked ??= requestAnimationFrame((now) => this.tick(now));
  }

  // One picture. While pictures follow one another their resolution adapts to the time that they take.
  tick(now) {
    this.asked = null;
    const passed = this.last === undefined ? 0 : now - this.last, { state } = this;
    const flew = this.flyBy(Math.min(passed, 100) / 1000), moving = state.playing || flew || this.changed;
    if (state.playing) this.advance(Math.min(passed, 250) / 1000);
    if (moving && passed > 0 && passed < 1000) this.adapt(passed);
    if (!moving) this.quality = 1;
    this.changed = false;
    this.draw(this.quality);
    this.last = now;
    clearTimeout(this.settling);
    if (state.playing || flew) this.redraw();
    else {
      this.last = undefined;
      if (moving && this.quality < 1) this.settling = setTimeout(() => this.draw(1), SETTLED_MS);
    }
  }

  adapt(passed) {
    this.recent = 0.8 * (this.recent ?? passed) + 0.2 * passed;
    if (this.recent > SLOW_MS) this.quality = Math.max(COARSEST, 0.85 * this.quality);
    else if (this.recent < QUICK_MS) this.quality = Math.min(1, 1.1 * this.quality);
  }

  advance(seconds) {
    const { state, model } = this, last = model.T - 1, time = state.time + seconds * FRAMES_PER_SECOND * state.speed;
    if (time > last && !state.loop) this.play(false);
    state.time = time <= last ? time : state.loop ? time % Math.max(last, 1) : last;
  }

  draw(quality) {
    const { canvas, gl, state, view } = this, ratio = Math.min(devicePixelRatio, 2), { width, height } = this.cssSize();
    if (!width || !height) return;
    const size = [width, height].map((side) => Math.max(1, Math.round(side * ratio)));
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    if (state.follow) view.stand(this.model.cameraAt(state.time));
    const inner = size.map((side) => Math.max(1, Math.round(side * quality)));
    this.render(view.fitted(...inner), inner, view.fit(...inner).scale, state.mode);
    this.lines.draw(view.fitted(...size), { time: state.time, width: size[0], height: size[1], show: state, ratio });
    this.panel.show();
  }

  render(camera, [width, height], scale, mode) {
    const { time } = this.state;
    this.splats.draw(camera, { time, width, height, scale, shown: this.state, mode, range: this.range });
  }

  // A picture from a camera { centre, rows, lens } at a time in frames, for tests: RGBA, top row last.
  pixels(camera, width, height, time, mode = "colour") {
    [this.canvas.width, this.canvas.height] = [width, height];
    this.state.time = time;
    this.render(camera, [width, height], 1, mode);
    const pixels = new Uint8Array(4 * width * height);
    this.gl.readPixels(0, 0, width, height, this.gl.RGBA, this.gl.UNSIGNED_BYTE, pixels);
    return pixels;
  }

  play(playing) {
    this.state.playing = playing;
    if (playing && this.state.time >= this.model.T - 1) this.state.time = 0;
    this.redraw();
  }

  seek(time, fine = false) {
    this.state.playing = false;
    this.state.time = Math.min(Math.max(fine ? time : Math.round(time), 0), this.model.T - 1);
    this.redraw();
  }

  step(frames) { this.seek(Math.round(this.state.time) + frames); }

  jump(frame) {
    this.seek(frame);
    this.follow(true);
    this.panel.say(`camera of frame ${this.model.scene.frames[frame]}`);
  }

  follow(follow) {
    this.state.follow = follow;
    this.redraw();
  }

  leaveCamera() { this.state.follow = false; }

  set(name, value) {
    this.state[name] = value;
    if (name === "split" && value) this.state.follow = true;  // the two pictures show the same only from there
    this.panel.say(`${name} ${value ? "on" : "off"}`);
    this.redraw();
  }

  toggleByKey(key) {
    const name = SWITCH_KEYS[key], modes = { z: "depth", i: "instances" };
    if (name && !document.querySelector(`[data-switch=${name}]`).closest("[hidden]")) this.set(name, !this.state[name]);
    else if (modes[key]) this.state.mode = this.state.mode === modes[key] ? "colour" : modes[key];
    else return false;
    document.getElementById("mode").value = this.state.mode;
    this.redraw();
    return true;
  }

  toggleHelp() {
    const help = document.getElementById("help");
    help.open = !help.open;
  }

  // Turn about what lies under a point of the window from now on.
  lookUpTarget(x, y) {
    const size = this.cssSize(), view = this.view.fitted(size.width, size.height), [fx, fy, cx, cy] = view.lens;
    const depth = this.splats.depthAt(view, { ...this.plain(size), scale: this.cssScale() }, x, y);
    if (depth === null) return;
    this.leaveCamera();
    this.view.turn(Math.atan((x - cx) / fx), -Math.atan((y - cy) / fy));
    this.view.distance = depth;
    this.redraw();
  }

  async screenshot() {
    this.draw(1);  // the canvas keeps its picture only until the browser shows it
    const { canvas, state, view, pictures, model } = this, sheet = document.createElement("canvas");
    [sheet.width, sheet.height] = [canvas.width, canvas.height];
    const context = sheet.getContext("2d"), { scale, margins } = view.fit(canvas.width, canvas.height);
    context.drawImage(canvas, 0, 0);
    if (state.split && pictures.length) {
      const input = document.getElementById("input");
      await input.decode();
      const [wide, high] = [scale * view.frame.width, scale * view.frame.height], at = state.splitAt;
      context.drawImage(input, 0, 0, at * input.naturalWidth, input.naturalHeight, ...margins, at * wide, high);
    }
    const link = document.createElement("a");
    link.href = sheet.toDataURL("image/png");
    link.download = `${model.scene.name}_${model.scene.frames[Math.round(state.time)]}.png`;
    link.click();
    this.panel.say("picture saved");
  }
}

function start() {
  const text = (id) => document.getElementById(id).textContent, canvas = document.getElementById("picture");
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
  if (!gl) {
    document.getElementById("missing").hidden = false;
    document.body.classList.add("without");
    return null;
  }
  canvas.addEventListener("webglcontextlost", () => { document.getElementById("lost").hidden = false; });
  const model = new Model(JSON.parse(text("scene")), text("blob"));
  document.getElementById("blob").remove();  // decoded: the text would keep its memory
  return new App(model, JSON.parse(text("pictures")), canvas, gl);
}

window.viewer = start();
