// The first look: level, from the camera whose picture fills the free part of the window and shows most.

const LOOKS = 24, ZOOMS = 5, COLUMNS = 24, ROWS = 16, ASKED = 40000, FILLED = 0.99, OPAQUE = 0.9;

// The whole of a camera's image in an area of pixels: focal length.
const focalOf = (about, { width, height }) => Math.min(width / about.slope[0], height / about.slope[1]);

function level(camera) {
  const forward = camera.r.slice(6), right = cross(forward, [0, 0, 1]);
  if (Math.hypot(...right) < 0.05) return camera; // straight down or up
  return { p: camera.p, r: [...unit(right), ...cross(forward, unit(right)), ...forward] };
}

// The camera, and how many times longer than `focalOf` the focal length is: of those that leave nothing empty the one
// that shows most of the map, else the one that leaves least empty.
function firstLook(cloud, about, area) {
  const step = Math.ceil(about.cameras.length / LOOKS), least = focalOf(about, area);
  const most = 1.1 * Math.max(area.width / about.slope[0], area.height / about.slope[1]);
  let best = null;
  for (const camera of about.cameras.filter((_, k) => k % step === 0).map(level)) {
    const seen = inFront(cloud, camera);
    for (let k = 0; k < ZOOMS; k++) {
      const zoom = (most / least) ** (k / (ZOOMS - 1)), { filled, shown } = fillOf(seen, least * zoom, about, area);
      const worth = filled < FILLED ? filled : 1 + shown;
      if (!best || worth > best.worth) best = { camera, zoom, worth };
    }
  }
  return best;
}

// Of some Gaussians before a camera that are surely seen from there: slopes, and share of an opaque square at depth 1.
function inFront(cloud, { p, r }) {
  const { places, colors, cones, count } = cloud, every = Math.ceil(count / ASKED), seen = [];
  for (let i = 0; i < count; i += every) {
    const x = places[4 * i] - p[0], y = places[4 * i + 1] - p[1], z = places[4 * i + 2] - p[2];
    const depth = r[6] * x + r[7] * y + r[8] * z, far = Math.hypot(x, y, z);
    if (depth <= NEAR || (cones[4 * i] * x + cones[4 * i + 1] * y + cones[4 * i + 2] * z) / -127 < (cones[4 * i + 3] / 127) * far) continue;
    const across = (r[0] * x + r[1] * y + r[2] * z) / depth, down = (r[3] * x + r[4] * y + r[5] * z) / depth;
    seen.push([across, down, (every * 2 * Math.PI * (colors[4 * i + 3] / 255) * places[4 * i + 3] ** 2) / depth ** 2]);
  }
  return { seen, all: count / every };
}

function fillOf({ seen, all }, focal, about, { width, height }) {
  const cells = new Float32Array(COLUMNS * ROWS), one = (width / COLUMNS) * (height / ROWS);
  let shown = 0;
  for (const [across, down, share] of seen) {
    const u = 0.5 + (focal * (across + about.shift[0])) / width, v = 0.5 + (focal * (down + about.shift[1])) / height;
    if (u < 0 || v < 0 || u >= 1 || v >= 1) continue;
    cells[Math.floor(v * ROWS) * COLUMNS + Math.floor(u * COLUMNS)] += (share * focal ** 2) / one;
    shown++;
  }
  return { filled: cells.reduce((sum, part) => sum + (part > OPAQUE), 0) / cells.length, shown: shown / all };
}
