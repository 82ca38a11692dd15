// The map on a WebGL2 canvas: a square for each Gaussian, far ones first.

const VERTEX = `#version 300 es
precision highp float; precision highp int;
in vec2 corner; in uint index;
uniform highp sampler2D places, colors, classes, palette, cones;
uniform mat3 turn; uniform vec3 place; uniform vec4 lens; uniform vec2 size; uniform bool byClass;
out vec2 sigmas; out vec4 color;
void main() {
  int wide = textureSize(places, 0).x;
  ivec2 at = ivec2(int(index) % wide, int(index) / wide);
  vec4 ball = texelFetch(places, at, 0);
  color = texelFetch(colors, at, 0);
  vec2 named = texelFetch(classes, at, 0).rg; // paler where it is uncertain
  if (byClass) color.rgb = mix(vec3(0.9), texelFetch(palette, ivec2(int(named.r * 255.0 + 0.5), 0), 0).rgb, named.g);
  vec4 cone = texelFetch(cones, at, 0);
  if (cone.xyz != vec3(0)) color.a *= smoothstep(cone.w - 0.35, cone.w, dot(normalize(cone.xyz), normalize(place - ball.xyz)));
  vec3 seen = turn * (ball.xyz - place);
  float sigma = sqrt(lens.x * lens.y) * ball.w / seen.z;
  float reach = sqrt(clamp(2.0 * log(color.a * 255.0), 0.0, ${CUT_SIGMAS * CUT_SIGMAS}.0));
  sigmas = corner * reach;
  vec2 pixel = lens.xy * seen.xy / seen.z + lens.zw + sigmas * sigma;
  gl_Position = vec4(pixel / size * vec2(2, -2) + vec2(-1, 1), 0, 1);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 sigmas; in vec4 color; out vec4 result;
void main() {
  float alpha = min(color.a * exp(-0.5 * dot(sigmas, sigmas)), ${ALPHA_MAX});
  if (alpha < ${ALPHA_MIN} || dot(sigmas, sigmas) > ${CUT_SIGMAS * CUT_SIGMAS}.0) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;

function makePicture(canvas, cloud, classColors) {
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error("This browser has no WebGL 2, which drawing the map needs.");
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const wide = Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), 2048), high = Math.ceil(cloud.count / wide);
  const filled = (array, channels) => {
    const whole = new array.constructor(wide * high * channels);
    whole.set(array);
    return whole;
  };
  const texture = (unit, name, inside, width, height, format, type, data) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, format, type, data);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.uniform1i(uniform(name), unit);
  };
  const palette = new Uint8Array(1024).fill(128);
  classColors.forEach((rgb, k) => palette.set(rgb, 4 * k));
  texture(0, "places", gl.RGBA32F, wide, high, gl.RGBA, gl.FLOAT, filled(cloud.places, 4));
  texture(1, "colors", gl.RGBA8, wide, high, gl.RGBA, gl.UNSIGNED_BYTE, filled(cloud.colors, 4));
  const named = new Uint8Array(2 * cloud.count).map((_, i) => (i % 2 ? cloud.sure : cloud.classes)[i >> 1]);
  texture(2, "classes", gl.RG8, wide, high, gl.RG, gl.UNSIGNED_BYTE, filled(named, 2));
  texture(3, "palette", gl.RGBA8, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, palette);
  texture(4, "cones", gl.RGBA8_SNORM, wide, high, gl.RGBA, gl.BYTE, filled(cloud.cones, 4));

  const attribute = (name, data, use) => {
    const buffer = gl.createBuffer(), where = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, use);
    gl.enableVertexAttribArray(where);
    return where;
  };
  gl.vertexAttribPointer(attribute("corner", new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW), 2, gl.FLOAT, false, 0, 0);
  const index = attribute("index", cloud.order, gl.DYNAMIC_DRAW);
  gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(index, 1);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);

  // lens: fx, fy, cx, cy in pixels of the canvas.
  return function draw(camera, lens, byClass) {
    const slopeX = Math.max(lens[2], canvas.width - lens[2]) / lens[0], slopeY = Math.max(lens[3], canvas.height - lens[3]) / lens[1];
    const seen = sortCloud(cloud, camera, slopeX * 1.2, slopeY * 1.2);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, cloud.order, 0, seen);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(uniform("turn"), true, camera.r);
    gl.uniform3fv(uniform("place"), camera.p);
    gl.uniform4fv(uniform("lens"), lens);
    gl.uniform2f(uniform("size"), canvas.width, canvas.height);
    gl.uniform1i(uniform("byClass"), byClass ? 1 : 0);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, seen);
  };
}
