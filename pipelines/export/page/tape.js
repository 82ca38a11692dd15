// Lengths: the tape between two places with its uncertainty, in the words that the program itself uses.

const AIM_PIXELS = 1;

function tapeBetween(first, second, about) {
  const way = plus(second.point, first.point, -1), length = Math.hypot(...way);
  const sd = (touch) => {
    if (length === 0) return touch.along;
    const share = dot(touch.direction, way.map((v) => v / length)) ** 2;
    return Math.sqrt(share * touch.along ** 2 + (1 - share) * touch.across ** 2);
  };
  return lengthText(length, Math.hypot(sd(first), sd(second)), about);
}

function lengthText(length, sd, about) {
  const { metric, per_unit, relative_sd } = about.unit;
  if (metric) return `${withSd(length, Math.hypot(sd, (relative_sd || 0) * length))} m`;
  if (!per_unit) return `${withSd(length, sd)} units`;
  return `${withSd(length, sd)} units ≈ ${withSd(per_unit * length, per_unit * Math.hypot(sd, relative_sd * length))} m`;
}

// Two digits of the deviation, the value to the same place.
function withSd(value, sd) {
  const digits = Math.max(0, Math.min(6, 1 - Math.floor(Math.log10(Math.max(sd, 1e-6)))));
  return `${value.toFixed(digits)} ± ${sd.toFixed(digits)}`;
}

// What a bar of about `pixels` pixels may say: 1, 2 or 5 times a power of ten of metres, else of units.
function scaleBar(unitsPerPixel, pixels, about) {
  const perUnit = about.unit.metric ? 1 : about.unit.per_unit || 1, most = unitsPerPixel * pixels * perUnit;
  const ten = 10 ** Math.floor(Math.log10(most)), round = ten * (most >= 5 * ten ? 5 : most >= 2 * ten ? 2 : 1);
  const note = `${+round.toPrecision(1)} ${about.unit.metric || about.unit.per_unit ? "m" : "units"}`;
  return { pixels: round / perUnit / unitsPerPixel, text: about.unit.metric || !about.unit.per_unit ? note : `≈ ${note}` };
}
