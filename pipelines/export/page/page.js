// The page: buttons, pointers, keys, what is drawn over the map. #camera=N in the address looks as the camera of
// frame N does, or the nearest one, &mode=classes in the colours of the classes, &bare shows nothing but the map.

const find = (id) => document.getElementById(id);
const about = JSON.parse(find("about").textContent);
const canvas = find("scene"), overlay = find("overlay"), note = find("note");
const wanted = new URLSearchParams(location.hash.slice(1)), bare = wanted.has("bare");
const state = { mode: wanted.get("mode") || "color", move: "orbit", measuring: false, ends: [], text: "", showPath: false, playing: 0, keyframes: [], thing: 0, hidden: [], alone: 0 };
const eye = makeEye(about);
let cloud, draw, choose, waiting = false, zoom = 1;

start().catch((error) => { find("message").textContent = `The map cannot be shown: ${error.message}`; });

async function start() {
  if (!window.DecompressionStream) throw new Error("this browser is too old to unpack it.");
  cloud = await unpackCloud(about, find("map").textContent);
  find("map").remove();
  cloud.cones = seenFrom(cloud, about);
  draw = makePicture(canvas, cloud, about.classes.map((c) => c.color));
  find("message").textContent = "";
  find("panel").hidden = bare;
  find("panel").classList.toggle("folded", onPhone());
  reset();
  keepOverReload(about, eye, state);
  addLegend();
  choose = addThings(cloud, about, state, note, again);
  addButtons();
  addPointers();
  addKeys();
  const metres = about.unit.metric ? "Lengths are metres." : about.unit.text || "Lengths have no known unit.";
  const shown = about.count < about.total ? `${about.count.toLocaleString("en")} of ${about.total.toLocaleString("en")}` : about.count.toLocaleString("en");
  find("facts").textContent = `${shown} ${about.elements}. ${metres}`;
  addEventListener("resize", again);
  const off = (camera) => Math.abs(camera.n - wanted.get("camera"));
  const nearest = about.cameras.reduce((best, camera) => (best && off(best) <= off(camera) ? best : camera), null);
  if (wanted.has("camera") && nearest) {
    eye.take(nearest, about.depth);
    zoom = 1;
  }
  paint();
  document.documentElement.dataset.ready = "1";
}

function reset() {
  const look = firstLook(cloud, about, freeArea());
  if (look) eye.take(look.camera, about.depth);
  else eye.look(plus(about.middle, [0, -2 * about.depth, 0.7 * about.depth]), about.middle);
  zoom = look ? look.zoom : 1;
  again();
}

const onPhone = () => matchMedia("(max-width: 600px)").matches;

// What the panel leaves of the map, in points of the screen; on a phone the two lie beside each other.
function freeArea() {
  const panel = find("panel"), left = bare || onPhone() || panel.classList.contains("folded") ? 0 : panel.offsetLeft + panel.offsetWidth;
  return { left, width: canvas.clientWidth - left, height: canvas.clientHeight };
}

function again() {
  if (!waiting) requestAnimationFrame(paint);
  waiting = true;
}

function lens() {
  const ratio = window.devicePixelRatio || 1, width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  for (const c of [canvas, overlay]) if (c.width !== width || c.height !== height) Object.assign(c, { width, height });
  const area = freeArea(), focal = ratio * zoom * focalOf(about, area), middle = ratio * (area.left + area.width / 2);
  return [focal, focal, middle + focal * about.shift[0], height / 2 + focal * about.shift[1]];
}

function paint() {
  waiting = false;
  const view = lens();
  draw(eye, view, state.mode === "classes");
  const pen = overlay.getContext("2d");
  pen.clearRect(0, 0, overlay.width, overlay.height);
  if (bare) return;
  const ratio = window.devicePixelRatio || 1;
  const onScreen = (point) => {
    const from = plus(point, eye.p, -1), depth = dot(eye.forward(), from);
    return depth < NEAR ? null : [(view[0] * dot(eye.r.slice(0, 3), from)) / depth + view[2], (view[1] * dot(eye.r.slice(3, 6), from)) / depth + view[3]];
  };
  const line = (points, color, width) => {
    pen.beginPath();
    let open = false;
    for (const xy of points.map(onScreen)) {
      if (xy) pen[open ? "lineTo" : "moveTo"](...xy);
      open = Boolean(xy);
    }
    Object.assign(pen, { strokeStyle: color, lineWidth: width * ratio });
    pen.stroke();
  };
  pen.font = `${13 * ratio}px system-ui, sans-serif`;
  const label = (text, x, y) => {
    if (pen.textAlign === "left" || pen.textAlign === "start") x = Math.max(4, Math.min(x, overlay.width - pen.measureText(text).width - 8 * ratio));
    Object.assign(pen, { lineWidth: 4 * ratio, strokeStyle: "#000", fillStyle: "#fff" });
    pen.strokeText(text, x, y);
    pen.fillText(text, x, y);
  };
  if (state.showPath) line(about.path, "#f97316", 2);
  const thing = about.things.find(({ n }) => n === state.thing);
  if (thing) edgesOf(thing).forEach((edge) => line(edge, "#fcd34d", 2));
  if (state.ends.length === 2) line(state.ends.map((e) => e.point), "#ef4444", 3);
  if (!state.playing) line(state.keyframes.map((key) => key.p), "#22c55e", 3);
  for (const xy of state.ends.map((e) => onScreen(e.point))) {
    if (!xy) continue;
    pen.beginPath();
    pen.arc(...xy, 5 * ratio, 0, 7);
    pen.fillStyle = "#ef4444";
    pen.fill();
  }
  for (const [k, key] of state.keyframes.entries()) {
    const xy = state.playing ? null : onScreen(key.p);
    if (xy) label(`${k + 1}`, ...xy);
  }
  if (state.ends.length === 2) {
    const middle = onScreen(plus(state.ends[0].point, plus(state.ends[1].point, state.ends[0].point, -1), 0.5));
    if (middle) label(state.text, middle[0] + 8 * ratio, middle[1] - 8 * ratio);
  }
  const bar = scaleBar(eye.distance() / view[0], 140 * ratio, about), x = overlay.width - 20 * ratio, y = overlay.height - 18 * ratio;
  pen.fillStyle = "#fff";
  pen.fillRect(x - bar.pixels, y, bar.pixels, 3 * ratio);
  pen.textAlign = "right";
  label(`${bar.text} at the orbit centre`, x, y - 6 * ratio);
  pen.textAlign = "left";
}

function addLegend() {
  if (!about.classes.length) document.querySelector("[data-mode=classes]").disabled = true;
  const met = about.classes.map((entry, k) => [entry, k]).filter(([entry]) => entry.share);
  met.sort(([a], [b]) => b.share - a.share).forEach(([entry, k]) => {
    const row = document.createElement("label"), box = document.createElement("input"), swatch = document.createElement("i");
    const share = document.createElement("span");
    Object.assign(box, { type: "checkbox", checked: true });
    box.onchange = () => { cloud.shown[k] = box.checked ? 1 : 0; again(); };
    swatch.style.background = `rgb(${entry.color})`;
    share.textContent = entry.share < 0.005 ? "< 1%" : `${Math.round(100 * entry.share)}%`;
    row.append(box, swatch, entry.name, share);
    find("legend").append(row);
  });
}

function addButtons() {
  const press = () => {
    for (const b of document.querySelectorAll("[data-mode]")) b.classList.toggle("on", b.dataset.mode === state.mode);
    for (const b of document.querySelectorAll("[data-move]")) b.classList.toggle("on", b.dataset.move === state.move);
    find("measure").classList.toggle("on", state.measuring);
    find("play").classList.toggle("on", Boolean(state.playing));
    find("legend").hidden = state.mode !== "classes";
    find("help").textContent = state.move === "orbit"
      ? "Drag: turn. Right drag or two fingers: move. Wheel or pinch: zoom. Double-click: set orbit centre."
      : "Drag: look around. W A S D or two fingers: walk. Q, E: down, up.";
    again();
  };
  for (const b of document.querySelectorAll("[data-mode]")) b.onclick = () => { state.mode = b.dataset.mode; press(); };
  for (const b of document.querySelectorAll("[data-move]")) b.onclick = () => { state.move = b.dataset.move; press(); };
  find("fold").onclick = () => { find("panel").classList.toggle("folded"); again(); };
  find("reset").onclick = () => { state.playing = 0; reset(); press(); };
  find("path").onchange = () => { state.showPath = find("path").checked; again(); };
  find("path").checked = state.showPath;
  const keyframes = () => {
    const count = state.keyframes.length, seconds = SECONDS_PER_KEYFRAME * (count - 1);
    note.textContent = count < 2 ? "A camera path needs keyframes at two views or more." : `${count} keyframes, ${seconds} s.`;
    offer();
    again();
  };
  const offer = () => {
    find("drop").hidden = !state.keyframes.length;
    find("save").hidden = state.keyframes.length < 2;
    find("play").hidden = about.cameras.length < 2 && state.keyframes.length < 2;
  };
  offer();
  find("keep").onclick = () => { state.keyframes.push({ p: eye.p.slice(), r: eye.r.slice() }); keyframes(); };
  find("drop").onclick = () => { state.keyframes.pop(); keyframes(); };
  find("save").onclick = () => {
    const name = `${document.title.replace(/[^\w.-]/g, "_")}-path.json`;
    download(name, recordedPath(state.keyframes, about));
    note.textContent = `msgs-slam render RUN out.mp4 --path ${name}`;
  };
  find("play").onclick = () => { state.playing = state.playing ? 0 : performance.now(); press(); if (state.playing) play(press); };
  find("measure").onclick = () => {
    Object.assign(state, { measuring: !state.measuring, ends: [], text: "" });
    note.textContent = state.measuring ? "Click or tap two places." : "";
    press();
  };
  press();
}

function play(done) {
  const own = state.keyframes.length > 1, cameras = own ? state.keyframes : about.cameras;
  const seconds = own ? SECONDS_PER_KEYFRAME * (cameras.length - 1) : Math.max(5, Math.min(60, cameras.at(-1).t - cameras[0].t));
  const whole = seconds * 1000;
  const step = () => {
    if (!state.playing) return;
    const at = ((performance.now() - state.playing) / whole) * (cameras.length - 1), k = Math.floor(at);
    if (k >= cameras.length - 1) { state.playing = 0; done(); return; }
    eye.take(between(cameras[k], cameras[k + 1], at - k), about.depth);
    paint();
    requestAnimationFrame(step);
  };
  step();
}

// A click chooses a thing, or a place to measure from; a double click the middle to turn around.
function click(x, y, asTarget) {
  const ratio = window.devicePixelRatio || 1, view = lens();
  const ray = [(x * ratio - view[2]) / view[0], (y * ratio - view[3]) / view[1], 1];
  const direction = unit([0, 1, 2].map((k) => ray[0] * eye.r[k] + ray[1] * eye.r[3 + k] + eye.r[6 + k]));
  const found = touchCloud(cloud, eye.p, direction);
  if (!found && !state.measuring && !asTarget) { choose(0); return; }
  if (!found) { note.textContent = "No surface there: click on the map."; return; }
  found.across = (AIM_PIXELS * ratio * found.depth) / view[0];
  if (asTarget) { eye.look(eye.p, found.point); again(); return; }
  if (!state.measuring) { choose(cloud.things[found.index]); return; }
  state.ends = state.ends.length === 1 ? [state.ends[0], found] : [found];
  state.text = state.ends.length === 2 ? tapeBetween(...state.ends, about) : "";
  const floor = about.floor ? ` ${lengthText(found.point[2], found.along, about)} over the floor.` : "";
  note.textContent = state.text || `Now the second place.${floor}`;
  again();
}

function addPointers() {
  const held = new Map();
  let moved = 0;
  canvas.oncontextmenu = (event) => event.preventDefault();
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
    if (held.size === 1) moved = 0;
    state.playing = 0;
    find("play").classList.remove("on");
  };
  canvas.onpointermove = (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY, perPixel = eye.distance() / lens()[0];
    const other = [...held.values()].find((e) => e.pointerId !== event.pointerId);
    moved += Math.abs(dx) + Math.abs(dy);
    if (other) {
      const gap = (e) => Math.hypot(e.clientX - other.clientX, e.clientY - other.clientY);
      if (state.move === "orbit") eye.zoom(gap(before) / Math.max(gap(event), 1));
      else eye.walk((gap(event) - gap(before)) * perPixel, 0, 0);
      eye.pan((dx / 2) * perPixel, (dy / 2) * perPixel);
    } else if (event.buttons & 6 || event.shiftKey) eye.pan(dx * perPixel, dy * perPixel);
    else if (state.move === "orbit") eye.orbit(dx * 0.004, dy * 0.004);
    else eye.gaze(dx * 0.004, dy * 0.004);
    held.set(event.pointerId, event);
    again();
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => {
    held.delete(event.pointerId);
    if (event.type === "pointerup" && moved < 8 && held.size === 0) click(event.clientX, event.clientY, false);
  };
  canvas.ondblclick = (event) => { if (!state.measuring) click(event.clientX, event.clientY, true); };
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const turn = Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.0015);
    if (state.move === "orbit") eye.zoom(turn);
    else eye.walk((1 - turn) * about.depth * 0.5, 0, 0);
    again();
  }, { passive: false });
}

function addKeys() {
  const moves = { w: [1, 0, 0], s: [-1, 0, 0], a: [0, -1, 0], d: [0, 1, 0], e: [0, 0, 1], q: [0, 0, -1] };
  Object.assign(moves, { arrowup: moves.w, arrowdown: moves.s, arrowleft: moves.a, arrowright: moves.d });
  const down = new Set();
  let before = 0;
  const step = (now) => {
    const far = (Math.min(now - before, 100) / 1000) * about.depth * 0.5;
    before = now;
    for (const key of down) eye.walk(...moves[key].map((v) => v * far));
    paint();
    if (down.size) requestAnimationFrame(step);
  };
  addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase();
    if (!moves[key] || event.ctrlKey || event.metaKey || down.has(key)) return;
    event.preventDefault();
    down.add(key);
    if (down.size === 1) requestAnimationFrame((now) => { before = now; step(now); });
  });
  addEventListener("keyup", (event) => down.delete(event.key.toLowerCase()));
  addEventListener("blur", () => down.clear());
}
