// The controls around the picture: buttons and sliders of scene.html.j2, in step with the state of the application.

const SWITCH_KEYS = {
  1: "static", 2: "dynamic", c: "points", t: "trajectories", p: "path", r: "frustums", v: "split", l: "loop",
};

class Panel {
  constructor(app) {
    this.app = app;
    this.part = (id) => document.getElementById(id);
    const { scene, T } = app.model;
    this.part("panel").open = innerWidth > 600;
    this.part("time").max = T - 1;
    for (const number of scene.frames) this.part("jump").add(new Option(`frame ${number}`));
    this.part("play").addEventListener("click", () => app.play(!app.state.playing));
    this.part("back").addEventListener("click", () => app.step(-1));
    this.part("next").addEventListener("click", () => app.step(1));
    this.part("time").addEventListener("input", (event) => app.seek(Number(event.target.value), true));
    this.part("speed").addEventListener("change", (event) => { app.state.speed = Number(event.target.value); });
    this.part("jump").addEventListener("change", (event) => {
      if (event.target.selectedIndex > 0) app.jump(event.target.selectedIndex - 1);
    });
    this.part("follow").addEventListener("click", () => app.follow(!app.state.follow));
    this.part("split-at").addEventListener("input", (event) => {
      app.state.splitAt = Number(event.target.value);
      this.showInput();
    });
    this.part("shot").addEventListener("click", () => app.screenshot());
    this.part("mode").addEventListener("change", (event) => {
      app.state.mode = event.target.value;
      app.redraw();
    });
    for (const box of document.querySelectorAll("input[data-switch]")) {
      box.addEventListener("change", () => app.set(box.dataset.switch, box.checked));
    }
    if (!app.pictures.length) this.part("split-row").hidden = true;
    if (!app.model.P) for (const row of document.querySelectorAll(".moving")) row.hidden = true;
  }

  // Everything that the state decides. Cheap, so it is called for every picture.
  show() {
    const { state, model } = this.app, frame = Math.round(state.time);
    const number = model.scene.frames[frame];
    this.part("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
    this.part("play").textContent = state.playing ? "❚❚" : "▶";
    this.part("time").value = state.time;
    this.part("time").setAttribute("aria-valuetext", `frame ${number}`);
    this.part("now").textContent = `${number} / ${model.scene.frames[model.T - 1]}`;
    this.part("follow").setAttribute("aria-pressed", state.follow);
    this.part("jump").selectedIndex = state.follow && Number.isInteger(state.time) ? frame + 1 : 0;
    for (const box of document.querySelectorAll("input[data-switch]")) box.checked = state[box.dataset.switch];
    this.part("split-at").disabled = !state.split;
    this.showInput();
  }

  // The input frame over the left part of the picture, where the frame lies if the camera is that of the clip.
  showInput() {
    const { state, pictures, view } = this.app, picture = this.part("input"), line = this.part("divider");
    picture.hidden = line.hidden = !state.split;
    this.part("caption").hidden = !state.split || state.follow;
    if (!state.split) return;
    const { width, height } = this.app.cssSize(), { scale, margins } = view.fit(width, height);
    const source = pictures[Math.round(state.time * (pictures.length - 1) / Math.max(this.app.model.T - 1, 1))];
    if (picture.src !== source) picture.src = source;
    const wide = scale * view.frame.width, at = margins[0] + state.splitAt * wide;
    Object.assign(picture.style, {
      left: `${margins[0]}px`, top: `${margins[1]}px`, width: `${wide}px`, height: `${scale * view.frame.height}px`,
      clipPath: `inset(0 ${100 * (1 - state.splitAt)}% 0 0)`,
    });
    Object.assign(line.style, { left: `${at}px`, top: `${margins[1]}px`, height: `${scale * view.frame.height}px` });
  }

  say(text) { this.part("status").textContent = text; }
}
