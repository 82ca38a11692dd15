// Where one looks from: around a place (orbit) or on foot (walk). z is up.

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, times = 1) => a.map((v, k) => v + times * b[k]);
const unit = (a) => a.map((v) => v / Math.hypot(...a));

function makeEye(about) {
  const eye = { p: [0, 0, 0], r: [1, 0, 0, 0, 0, -1, 0, 1, 0], yaw: 0, pitch: 0, target: [0, 0, 0], fov: about.fov };

  // Upright, by yaw about z and pitch.
  eye.turn = () => {
    eye.pitch = Math.max(-1.55, Math.min(1.55, eye.pitch));
    const level = Math.cos(eye.pitch);
    const forward = [Math.cos(eye.yaw) * level, Math.sin(eye.yaw) * level, Math.sin(eye.pitch)];
    const right = unit(cross(forward, [0, 0, 1]));
    eye.r = [...right, ...cross(forward, right), ...forward];
  };
  eye.forward = () => eye.r.slice(6);
  eye.distance = () => Math.hypot(...plus(eye.target, eye.p, -1));
  eye.keepTurn = () => {
    const [x, y, z] = eye.forward();
    eye.yaw = Math.atan2(y, x);
    eye.pitch = Math.asin(Math.max(-1, Math.min(1, z)));
  };
  eye.look = (p, target) => {
    const [x, y, z] = plus(target, p, -1);
    Object.assign(eye, { p, target, yaw: Math.atan2(y, x), pitch: Math.atan2(z, Math.hypot(x, y)) });
    eye.turn();
  };
  // Exactly as a camera of the run stood, tilt and all, till one drags.
  eye.take = (camera, depth) => {
    Object.assign(eye, { p: camera.p.slice(), r: camera.r.slice() });
    eye.target = plus(eye.p, eye.forward(), depth);
    eye.keepTurn();
  };
  eye.orbit = (dx, dy) => {
    const far = eye.distance();
    eye.yaw -= dx;
    eye.pitch -= dy;
    eye.turn();
    eye.p = plus(eye.target, eye.forward(), -far);
  };
  eye.gaze = (dx, dy) => {
    const far = eye.distance();
    eye.yaw += dx;
    eye.pitch += dy;
    eye.turn();
    eye.target = plus(eye.p, eye.forward(), far);
  };
  eye.pan = (dx, dy) => {
    const move = plus(eye.r.slice(0, 3).map((v) => -v * dx), eye.r.slice(3, 6), -dy);
    eye.p = plus(eye.p, move);
    eye.target = plus(eye.target, move);
  };
  eye.zoom = (factor) => {
    eye.p = plus(eye.target, plus(eye.p, eye.target, -1), factor);
  };
  eye.walk = (ahead, aside, up) => {
    const move = plus(plus(eye.forward().map((v) => v * ahead), eye.r.slice(0, 3), aside), [0, 0, 1], up);
    eye.p = plus(eye.p, move);
    eye.target = plus(eye.target, move);
  };
  return eye;
}

// A place on the camera's path, `share` of the way from camera to camera.
function between(a, b, share) {
  const mixed = a.r.map((v, k) => v + share * (b.r[k] - v));
  const forward = unit(mixed.slice(6)), right = unit(cross(mixed.slice(3, 6), forward));
  return { p: a.p.map((v, k) => v + share * (b.p[k] - v)), r: [...right, ...cross(forward, right), ...forward] };
}
