// A camera path of one's own, by keyframes, for `msgs-slam render RUN out.mp4 --path FILE`; and what a page that is
// loaded again, as its server does when there is more to see, takes over from the one before.

const SECONDS_PER_KEYFRAME = 2;

function recordedPath(keyframes, about) {
  const { world, turn, shift } = about.recorded, turned = (v) => [0, 3, 6].map((k) => dot(turn.slice(k, k + 3), v));
  const rows = keyframes.map(({ p, r }) => {
    const axes = [0, 3, 6].map((k) => turned(r.slice(k, k + 3))); // right, down, forward: the columns of the rotation
    return { position: plus(turned(p), shift), rotation_wxyz: quaternion([0, 1, 2].flatMap((k) => axes.map((a) => a[k]))),
      fov_degrees: 2 * Math.atan(about.slope[1] / 2) / DEGREE };
  });
  const path = { format: "msgs-slam camera path 1", world, fps: 30, seconds_per_keyframe: SECONDS_PER_KEYFRAME, keyframes: rows };
  return JSON.stringify(path, null, 1);
}

// w, x, y, z of a rotation given row by row; from whichever of them is the largest.
function quaternion(m) {
  const wx = m[7] - m[5], wy = m[2] - m[6], wz = m[3] - m[1], xy = m[1] + m[3], xz = m[2] + m[6], yz = m[5] + m[7];
  const squares = [1 + m[0] + m[4] + m[8], 1 + m[0] - m[4] - m[8], 1 + m[4] - m[0] - m[8], 1 + m[8] - m[0] - m[4]];
  const all = [[squares[0], wx, wy, wz], [wx, squares[1], xy, xz], [wy, xy, squares[2], yz], [wz, xz, yz, squares[3]]];
  return unit(all[squares.indexOf(Math.max(...squares))]);
}

function download(name, text) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(new Blob([text])), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

function keepOverReload(about, eye, state) {
  if (!location.protocol.startsWith("http")) return;
  const { world, turn, shift } = about.recorded, name = document.title, place = JSON.stringify([world, turn, shift]);
  const kept = JSON.parse(sessionStorage.getItem(name) || "null");
  if (kept && kept.place === place) {
    Object.assign(eye, kept.eye);
    Object.assign(state, kept.state);
  }
  addEventListener("pagehide", () => {
    const { p, r, yaw, pitch, target } = eye, { mode, move, showPath, keyframes } = state;
    const text = { place, eye: { p, r, yaw, pitch, target }, state: { mode, move, showPath, keyframes } };
    sessionStorage.setItem(name, JSON.stringify(text));
  });
}
