// Mouse, touch and keys over the picture. `app` is the application of main.js.

const ORBIT_PER_PX = 0.005, LOOK_PER_PX = 0.003, ORBIT_PER_KEY = 0.06, ZOOM_PER_KEY = 1.1, FLY_PER_SECOND = 0.5;
const FLY_KEYS = {
  w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0],
};

function listenToPointers(app, canvas) {
  const pointers = new Map();
  let apart = 0;
  const middle = () => {
    const all = [...pointers.values()];
    return [0, 1].map((k) => all.reduce((sum, place) => sum + place[k], 0) / all.length);
  };
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (pointers.size === 2) apart = spread();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return;
    const before = middle();
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = middle(), dx = after[0] - before[0], dy = after[1] - before[1];
    app.leaveCamera();
    if (pointers.size > 1) {
      app.view.zoom(apart / Math.max(spread(), 1));
      apart = spread();
      app.view.pan(dx, dy, app.cssScale());
    } else if (event.shiftKey || event.buttons & 6) app.view.pan(dx, dy, app.cssScale());
    else if (event.ctrlKey || event.altKey) app.view.turn(-LOOK_PER_PX * dx, LOOK_PER_PX * dy);
    else app.view.orbit(-ORBIT_PER_PX * dx, ORBIT_PER_PX * dy);
    app.redraw();
  });
  const leave = (event) => pointers.delete(event.pointerId);
  canvas.addEventListener("pointerup", leave);
  canvas.addEventListener("pointercancel", leave);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", (event) => app.lookUpTarget(event.offsetX, event.offsetY));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    app.leaveCamera();
    app.view.zoom(1.0015 ** event.deltaY);
    app.redraw();
  }, { passive: false });
}

function listenToKeys(app) {
  const held = new Set();
  const commands = {
    " ": () => app.play(!app.state.playing), f: () => app.follow(true), k: () => app.screenshot(),
    Home: () => app.seek(0), End: () => app.seek(app.model.T - 1), "?": () => app.toggleHelp(),
    ArrowLeft: () => app.step(-1), ArrowRight: () => app.step(1), ArrowUp: () => zoom(1 / ZOOM_PER_KEY),
    ArrowDown: () => zoom(ZOOM_PER_KEY), "+": () => zoom(1 / ZOOM_PER_KEY), "-": () => zoom(ZOOM_PER_KEY),
  };
  const zoom = (factor) => {
    app.leaveCamera();
    app.view.zoom(factor);
    app.redraw();
  };
  const orbits = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { tagName } = event.target, own = tagName === "INPUT" || tagName === "SELECT";
    if (own || ((tagName === "BUTTON" || tagName === "SUMMARY") && [" ", "Enter"].includes(event.key))) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.shiftKey && key in orbits) {
      app.leaveCamera();
      app.view.orbit(...orbits[key].map((turns) => turns * ORBIT_PER_KEY));
      app.redraw();
    } else if (key in FLY_KEYS) {
      held.add(key);
      app.redraw();
    } else if (key in commands) commands[key]();
    else if (!app.toggleByKey(key)) return;
    event.preventDefault();
  });
  addEventListener("keyup", (event) => held.delete(event.key.toLowerCase()));
  addEventListener("blur", () => held.clear());
  // Move by the keys that are held; whether there are any.
  return (seconds) => {
    if (!held.size) return false;
    const step = FLY_PER_SECOND * seconds * Math.max(app.view.distance, 0.2);
    app.leaveCamera();
    for (const key of held) app.view.fly(...FLY_KEYS[key].map((direction) => direction * step));
    return true;
  };
}
