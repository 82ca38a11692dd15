// Things: one is chosen by a click or in the list, hidden, or shown alone; and the command that does the same to files.

function describe(thing) {
  const seen = `seen in ${thing.views} view${thing.views === 1 ? "" : "s"}`;
  const called = thing.called ? `, ${Math.round(100 * thing.called)}% of it called so` : "";
  return `${thing.name}: ${thing.text}, ${seen}, ${Math.round(100 * thing.sure)}% sure${called}`;
}

// The twelve edges of its box, each as two places.
function edgesOf({ center, axes, size }) {
  const corner = (k) => axes.reduce((at, axis, j) => plus(at, axis, ((k >> j & 1) - 0.5) * size[j]), center);
  const near = [...Array(8).keys()].flatMap((k) => [0, 1, 2].filter((j) => !(k >> j & 1)).map((j) => [k, k | 1 << j]));
  return near.map((pair) => pair.map(corner));
}

function showThings(cloud, about, state) {
  cloud.shownThings.fill(state.alone ? 0 : 1);
  if (state.alone) cloud.shownThings[state.alone] = 1;
  else for (const n of state.hidden) cloud.shownThings[n] = 0;
}

function commandOf(about, state) {
  const name = (n) => about.things.find((thing) => thing.n === n).name;
  const away = state.hidden.length ? state.hidden : [state.thing];
  const what = state.alone ? `--only-things "${name(state.alone)}"` : `--without "${away.map(name).join(",")}"`;
  return `msgs-slam export RUN ${what}`;
}

function addThings(cloud, about, state, note, again) {
  const list = find("things"), of = (n) => about.things.find((thing) => thing.n === n);
  const update = () => {
    find("thing").hidden = !state.thing && !state.hidden.length;
    for (const id of ["hide", "alone"]) find(id).disabled = !state.thing;
    find("hide").textContent = state.hidden.includes(state.thing) ? "Show" : "Hide";
    find("alone").classList.toggle("on", Boolean(state.alone));
    list.value = String(state.thing);
    showThings(cloud, about, state);
    again();
  };
  const choose = (n) => {
    state.thing = of(n) ? n : 0;
    note.textContent = state.thing ? describe(of(n)) : "";
    update();
  };
  list.hidden = !about.things.length;
  list.append(...about.things.map((thing) => new Option(thing.name, thing.n)));
  list.onchange = () => choose(Number(list.value));
  find("hide").onclick = () => {
    const { hidden, thing } = state;
    state.hidden = hidden.includes(thing) ? hidden.filter((n) => n !== thing) : [...hidden, thing];
    state.alone = 0;
    update();
  };
  find("alone").onclick = () => { state.alone = state.alone ? 0 : state.thing; update(); };
  find("all").onclick = () => { Object.assign(state, { alone: 0, hidden: [], thing: 0 }); choose(0); };
  find("copy").onclick = () => {
    note.textContent = commandOf(about, state);
    navigator.clipboard?.writeText(note.textContent).catch(() => {}); // it stands there to be copied by hand too
  };
  update();
  return choose;
}
