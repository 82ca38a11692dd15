// The Gaussians: unpacked from the page, sorted for a view, met by a line of sight.
// A camera is {r: 9 numbers, rows right, down, forward; p: its place}; the world's z is up.

const NEAR = 0.01, CUT_SIGMAS = 3, ALPHA_MIN = 1 / 255, ALPHA_MAX = 0.99;
const BUCKETS = 1 << 18;

async function unpackCloud(about, base64) {
  const packed = Uint8Array.from(atob(base64.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const n = about.count, plane = (k) => bytes.subarray(k * n, (k + 1) * n);
  const places = new Float32Array(4 * n), colors = new Uint8Array(4 * n);
  for (let axis = 0; axis < 3; axis++) {
    const high = plane(2 * axis), low = plane(2 * axis + 1), start = about.low[axis];
    const step = (about.high[axis] - start) / 65535;
    for (let i = 0, value = 0; i < n; i++) {
      value = (value + (high[i] << 8) + low[i]) & 65535; // each is the difference to the one before
      const log = start + step * value;
      places[4 * i + axis] = Math.sign(log) * Math.expm1(Math.abs(log));
    }
  }
  const radii = plane(6), [smallest, largest] = about.log_radii;
  for (let i = 0; i < n; i++) {
    places[4 * i + 3] = Math.exp(smallest + ((largest - smallest) * radii[i]) / 255);
    for (let c = 0; c < 4; c++) colors[4 * i + c] = bytes[(7 + c) * n + i];
  }
  const [shown, shownThings] = [0, 1].map(() => new Uint8Array(256).fill(1));
  return { count: n, places, colors, classes: plane(11), things: plane(12), sure: plane(13), order: new Uint32Array(n), shown, shownThings };
}

// Fills cloud.order far to near with what a camera can see and returns how many those are. The bits of a positive
// float grow with it, so they are its place in a counting sort as they are.
const sorting = { key: null, counts: new Uint32Array(BUCKETS + 1), float: new Float32Array(1), bits: null, from: 0 };
sorting.bits = new Uint32Array(sorting.float.buffer);
sorting.float[0] = NEAR;
sorting.from = sorting.bits[0];

function sortCloud(cloud, camera, slopeX, slopeY) {
  const { places, classes, things, shown, shownThings, order } = cloud, { r, p } = camera, { counts, float, bits, from } = sorting;
  if (!sorting.key || sorting.key.length < cloud.count) sorting.key = new Uint32Array(cloud.count);
  const key = sorting.key, hidden = BUCKETS;
  counts.fill(0);
  for (let i = 0; i < cloud.count; i++) {
    const x = places[4 * i] - p[0], y = places[4 * i + 1] - p[1], z = places[4 * i + 2] - p[2];
    const depth = r[6] * x + r[7] * y + r[8] * z, reach = CUT_SIGMAS * places[4 * i + 3];
    const across = Math.abs(r[0] * x + r[1] * y + r[2] * z), down = Math.abs(r[3] * x + r[4] * y + r[5] * z);
    if (depth <= NEAR || across > slopeX * depth + reach || down > slopeY * depth + reach || !shown[classes[i]] || !shownThings[things[i]]) {
      key[i] = hidden;
      continue;
    }
    float[0] = depth;
    const k = Math.min((bits[0] - from) >>> 9, BUCKETS - 1);
    key[i] = k;
    counts[k]++;
  }
  let seen = 0;
  for (let k = BUCKETS - 1; k >= 0; k--) {
    const these = counts[k];
    counts[k] = seen;
    seen += these;
  }
  for (let i = 0; i < cloud.count; i++) if (key[i] !== hidden) order[counts[key[i]]++] = i;
  return seen;
}

// From where the cameras saw each Gaussian: the mean direction, and the cosine to it up to which it is sure, the larger
// the fewer they were; in 127ths, 0 where none did. Walls fade for who looks at them from behind.
const MOST_ASKED = 24, DEGREE = Math.PI / 180;

function seenFrom(cloud, about) {
  const { places, count } = cloud, asked = Math.ceil(about.cameras.length / MOST_ASKED);
  const cameras = about.cameras.filter((_, k) => k % asked === 0), cones = new Int8Array(4 * count);
  const met = new Float64Array(3 * cameras.length);
  for (let i = 0; i < count; i++) {
    let n = 0, mx = 0, my = 0, mz = 0, least = 1;
    for (const { r, p } of cameras) {
      const x = p[0] - places[4 * i], y = p[1] - places[4 * i + 1], z = p[2] - places[4 * i + 2];
      const depth = -(r[6] * x + r[7] * y + r[8] * z), far = Math.hypot(x, y, z);
      if (depth <= NEAR || 2 * Math.abs(r[0] * x + r[1] * y + r[2] * z) > about.slope[0] * depth) continue;
      if (2 * Math.abs(r[3] * x + r[4] * y + r[5] * z) > about.slope[1] * depth) continue;
      mx += met[3 * n] = x / far;
      my += met[3 * n + 1] = y / far;
      mz += met[3 * n + 2] = z / far;
      n++;
    }
    const length = Math.hypot(mx, my, mz);
    if (length < 1e-6) continue;
    for (let k = 0; k < n; k++) least = Math.min(least, (met[3 * k] * mx + met[3 * k + 1] * my + met[3 * k + 2] * mz) / length);
    const sure = Math.min(Math.acos(least) + (30 + 5 * Math.min(n, 5)) * DEGREE, Math.PI);
    [mx / length, my / length, mz / length, Math.cos(sure)].forEach((v, k) => { cones[4 * i + k] = Math.round(127 * v); });
  }
  return cones;
}

// Where a line of sight meets the map: the median of its light's way, the Gaussian there, and half the span of the
// middle 68 % of it.
function touchCloud(cloud, origin, direction) {
  const { places, colors, classes, things, shown, shownThings } = cloud, met = [];
  for (let i = 0; i < cloud.count; i++) {
    if (!shown[classes[i]] || !shownThings[things[i]]) continue;
    const x = places[4 * i] - origin[0], y = places[4 * i + 1] - origin[1], z = places[4 * i + 2] - origin[2];
    const depth = x * direction[0] + y * direction[1] + z * direction[2], radius = places[4 * i + 3];
    const missed = (x * x + y * y + z * z - depth * depth) / (radius * radius);
    if (depth > 0 && missed < CUT_SIGMAS * CUT_SIGMAS)
      met.push([depth, Math.min((colors[4 * i + 3] / 255) * Math.exp(-missed / 2), ALPHA_MAX), i]);
  }
  met.sort((a, b) => a[0] - b[0]);
  let left = 1;
  const covered = met.map(([, alpha]) => 1 - (left *= 1 - alpha)), all = 1 - left;
  if (all < 0.5) return null;
  const at = (share) => met[covered.findIndex((c) => c >= share * all)];
  const [depth, , index] = at(0.5), along = (at(0.84)[0] - at(0.16)[0]) / 2;
  return { point: origin.map((v, k) => v + depth * direction[k]), direction, along, depth, index };
}
