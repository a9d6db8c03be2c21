"use strict";
// The viewer that the pages share. A page gives the clouds and says what each view shows of them; here they are
// unpacked, painted, turned and measured.

const element = (id) => document.getElementById(id);
const sceneOfPage = () => JSON.parse(element("scene").textContent);

// Clouds as they are packed by pack.py

const HALF_RANGE = 32767.5; // coordinate = step (integer - HALF_RANGE), about the cloud's centre

async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Rows of three numbers, of planes of the bytes of their differences. */
function summed(planes, Kind) {
  const size = Kind.BYTES_PER_ELEMENT, count = planes.length / (3 * size), values = new Kind(3 * count);
  for (let axis = 0; axis < 3; axis++) {
    for (let i = 0, value = 0; i < count; i++) {
      for (let byte = 0; byte < size; byte++) value += planes[(3 * byte + axis) * count + i] << 8 * byte;
      values[3 * i + axis] = value; // modulo the range of Kind
    }
  }
  return values;
}

/** A cloud with its points (integers about its centre) and, where it has colours of its own, those. */
async function unpacked(packed, name, colour) {
  return {
    name, colour, step: packed.step, centre: packed.centre,
    points: summed(await inflate(packed.points), Uint16Array),
    tints: packed.colours ? summed(await inflate(packed.colours), Uint8Array) : null,
  };
}

/** Passes on the start of a page, and says so where it fails: a browser may be too old to unpack the points. */
function begun(start) {
  start.catch((error) => {
    const textContent = `The points cannot be shown (${error.message}): a browser of 2023 or newer is needed.`;
    Object.assign(element("warning"), { hidden: false, textContent });
    console.error(error);
  });
  return start;
}

// Matrices: 4x4, column-major, as WebGL wants them

function multiply(a, b) {
  const product = new Float64Array(16);
  for (let i = 0; i < 16; i++) {
    const row = i % 4, column = i - row;
    for (let k = 0; k < 4; k++) product[i] += a[row + 4 * k] * b[column + k];
  }
  return product;
}
const fromRows = ([a, b, c]) => [a[0], b[0], c[0], 0, a[1], b[1], c[1], 0, a[2], b[2], c[2], 0, a[3], b[3], c[3], 1];
const translation = (x, y, z) => [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1];
const scaling = (s) => [s, 0, 0, 0, 0, s, 0, 0, 0, 0, s, 0, 0, 0, 0, 1];
const IDENTITY = scaling(1);
const chain = (...matrices) => matrices.reduce(multiply);
const moved = (m, [x, y, z]) => [0, 1, 2].map((r) => m[r] * x + m[r + 4] * y + m[r + 8] * z + m[r + 12]);

function turn(axis, angle) { // 0 about x, 1 about y
  const c = Math.cos(angle), s = Math.sin(angle);
  if (axis === 0) return fromRows([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0]]);
  return fromRows([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0]]);
}

function perspective(focal, aspect, near, far) {
  const depth = near - far;
  return [focal / aspect, 0, 0, 0, 0, focal, 0, 0, 0, 0, (far + near) / depth, -1, 0, 0, 2 * far * near / depth, 0];
}

/** A cloud's integers to the coordinates about its centre. */
const toLocal = ({ step }) => chain(scaling(step), translation(-HALF_RANGE, -HALF_RANGE, -HALF_RANGE));

/** Where a matrix to clip space puts a point in pixels, and how far away; null behind the camera. */
function projected(m, [x, y, z], { width, height, near }) {
  const w = m[3] * x + m[7] * y + m[11] * z + m[15];
  const at = (r) => (m[r] * x + m[r + 4] * y + m[r + 8] * z + m[r + 12]) / w;
  return w < near ? null : [(0.5 + 0.5 * at(0)) * width, (0.5 - 0.5 * at(1)) * height, w];
}

const UPRIGHT = { // rotations that take the axis called up to the screen's y
  "+x": fromRows([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0]]),
  "-x": fromRows([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0]]),
  "+y": IDENTITY,
  "-y": fromRows([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0]]),
  "+z": fromRows([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]),
  "-z": fromRows([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0]]),
};
const FOCAL = 1 / Math.tan(Math.PI / 12); // 30 degrees: enough depth, little distortion

// Colours

const parse = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
const css = (colour) => `rgb(${Array.from(colour, (value) => Math.round(255 * value)).join()})`;
const mix = (a, b, share) => a.map((value, i) => value + share * (b[i] - value));
const themeColour = (name) => parse(getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
const darkTheme = matchMedia("(prefers-color-scheme: dark)");

// Painting with WebGL: the points into a texture, then shaded by depth so that their shape shows, then the lines

const POINT_VERTEX = `#version 300 es
uniform mat4 matrix;
uniform float reach, pale;
uniform vec3 colour, background;
uniform bool own;
in vec3 point, tint;
out vec3 shade;
void main() {
  gl_Position = matrix * vec4(point, 1.0);
  gl_PointSize = clamp(reach / gl_Position.w, 1.0, 48.0);
  shade = mix(own ? tint : colour, background, pale);
}`;

const POINT_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 shade;
out vec4 fragment;
void main() {
  vec2 place = gl_PointCoord - 0.5;
  if (dot(place, place) > 0.25) discard;
  fragment = vec4(shade, 1.0);
}`;

const SCREEN_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

// eye-dome lighting: a pixel is the darker the nearer its neighbours are
const SHADE_FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D image, depths;
uniform float near, far, ratio;
out vec4 fragment;
float range(float depth) { return near * far / (far - depth * (far - near)); }
void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);
  fragment = texelFetch(image, here, 0);
  float depth = texelFetch(depths, here, 0).r;
  if (depth == 1.0) return;
  float own = log2(range(depth)), response = 0.0;
  ivec2 last = textureSize(depths, 0) - 1;
  for (int i = 0; i < 8; i++) {
    float angle = float(i) * 0.7853982;
    ivec2 there = here + ivec2(round(vec2(cos(angle), sin(angle)) * 1.4 * ratio));
    float other = texelFetch(depths, clamp(there, ivec2(0), last), 0).r;
    if (other < 1.0) response += clamp(own - log2(range(other)), 0.0, 0.02);
  }
  fragment.rgb *= exp(-9.0 * response);
}`;

const LINE_VERTEX = `#version 300 es
uniform mat4 from, to;
uniform vec2 viewport;
uniform float width;
uniform bool dots;
in vec3 start, end, tint;
out vec3 colour;
out float across;
void main() {
  vec4 a = from * vec4(start, 1.0), b = to * vec4(end, 1.0);
  colour = tint;
  across = 0.0;
  if (dots) {
    gl_Position = gl_VertexID == 0 ? a : b;
    gl_PointSize = 3.0 * width;
  } else if (a.w <= 0.0 || b.w <= 0.0) {
    gl_Position = vec4(2.0);
  } else {
    vec2 along = (b.xy / b.w - a.xy / a.w) * viewport;
    vec2 normal = vec2(-along.y, along.x) / max(length(along), 1e-6);
    across = float(gl_VertexID & 1) * 2.0 - 1.0;
    gl_Position = gl_VertexID < 2 ? a : b;
    gl_Position.xy += normal * across * 2.0 * width / viewport * gl_Position.w;
  }
}`;

const LINE_FRAGMENT = `#version 300 es
precision mediump float;
uniform vec3 background;
uniform bool dots;
in vec3 colour;
in float across;
out vec4 fragment;
void main() {
  float edge = dots ? 2.0 * length(gl_PointCoord - 0.5) : abs(across);
  if (edge > 1.0) discard;
  // the rim in the background's colour keeps crossing lines apart
  fragment = edge > 0.55 ? vec4(background, 0.75) : vec4(colour, 1.0);
}`;

class WebGLPainter {
  ratio = Math.min(2, Math.max(1.5, devicePixelRatio || 1));

  constructor(canvas, again) {
    // preserved, so that a printer finds the picture
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false, preserveDrawingBuffer: true });
    this.prepare();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.prepare(); again(); });
  }

  prepare() {
    this.programs = {
      points: this.program(POINT_VERTEX, POINT_FRAGMENT),
      shade: this.program(SCREEN_VERTEX, SHADE_FRAGMENT),
      lines: this.program(LINE_VERTEX, LINE_FRAGMENT),
    };
    this.buffers = new Map();
    this.layer = null;
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    const linked = gl.getProgramParameter(program, gl.LINK_STATUS) || gl.isContextLost();
    if (!linked) throw new Error(gl.getProgramInfoLog(program));
    return {
      program,
      at: (name) => gl.getUniformLocation(program, name),
      slot: (name) => gl.getAttribLocation(program, name),
    };
  }

  /** Binds the buffer of an array, which is sent the first time. */
  bind(values) {
    const gl = this.gl, known = this.buffers.get(values);
    gl.bindBuffer(gl.ARRAY_BUFFER, known || gl.createBuffer());
    if (known) return;
    this.buffers.set(values, gl.getParameter(gl.ARRAY_BUFFER_BINDING));
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  }

  /** Colour and depth textures of the canvas's size to paint the points into. */
  resize(width, height) {
    const gl = this.gl, old = this.layer;
    if (old && old.width === width && old.height === height) return;
    if (old) { gl.deleteTexture(old.image); gl.deleteTexture(old.depths); gl.deleteFramebuffer(old.target); }
    const texture = (format) => {
      const made = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      return made;
    };
    const image = texture(gl.RGBA8), depths = texture(gl.DEPTH_COMPONENT24), target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depths, 0);
    this.layer = { width, height, image, depths, target };
  }

  paint(frame) {
    this.resize(frame.width, frame.height);
    this.gl.viewport(0, 0, frame.width, frame.height);
    for (const [clouds, opacity] of frame.layers) {
      this.paintPoints(frame, clouds);
      this.shade(frame, opacity);
    }
    if (frame.lines) this.paintLines(frame);
  }

  paintPoints(frame, clouds) {
    const gl = this.gl, { program, at, slot } = this.programs.points;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.layer.target);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(...frame.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(program);
    gl.uniform1f(at("reach"), frame.reach);
    gl.uniform3fv(at("background"), frame.background);
    for (const { points, tints, matrix, colour, pale } of clouds) {
      gl.uniformMatrix4fv(at("matrix"), false, new Float32Array(matrix));
      gl.uniform3fv(at("colour"), colour);
      gl.uniform1f(at("pale"), pale);
      gl.uniform1i(at("own"), tints ? 1 : 0);
      this.attribute(slot("point"), points, gl.UNSIGNED_SHORT, 6, 0);
      if (tints) this.attribute(slot("tint"), tints, gl.UNSIGNED_BYTE, 3, 0, 0, true);
      else gl.disableVertexAttribArray(slot("tint"));
      gl.drawArrays(gl.POINTS, 0, points.length / 3);
    }
    gl.disableVertexAttribArray(slot("tint"));
  }

  shade(frame, opacity) {
    const gl = this.gl, { program, at } = this.programs.shade;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendColor(0, 0, 0, opacity);
    gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
    gl.useProgram(program);
    [this.layer.image, this.layer.depths].forEach((texture, i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.uniform1i(at("depths"), 1);
    for (const name of ["near", "far", "ratio"]) gl.uniform1f(at(name), frame[name]);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
  }

  paintLines({ lines: { ends, tints, runs, from, to }, width, height, ratio, background }) {
    const gl = this.gl, { program, at, slot } = this.programs.lines;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program);
    gl.uniformMatrix4fv(at("from"), false, new Float32Array(from));
    gl.uniformMatrix4fv(at("to"), false, new Float32Array(to));
    gl.uniform2f(at("viewport"), width, height);
    gl.uniform1f(at("width"), 1.9 * ratio);
    gl.uniform3fv(at("background"), background);
    for (const [first, count] of runs) {
      this.attribute(slot("start"), ends, gl.FLOAT, 24, 24 * first, 1);
      this.attribute(slot("end"), ends, gl.FLOAT, 24, 24 * first + 12, 1);
      this.attribute(slot("tint"), tints, gl.FLOAT, 12, 12 * first, 1);
      gl.uniform1i(at("dots"), 0);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
      gl.uniform1i(at("dots"), 1);
      gl.drawArraysInstanced(gl.POINTS, 0, 2, count);
    }
    gl.disable(gl.BLEND);
    for (const name of ["start", "end", "tint"]) gl.disableVertexAttribArray(slot(name));
  }

  attribute(slot, values, type, stride, offset, divisor = 0, normalised = false) {
    const gl = this.gl;
    this.bind(values);
    gl.enableVertexAttribArray(slot);
    gl.vertexAttribPointer(slot, 3, type, normalised, stride, offset);
    gl.vertexAttribDivisor(slot, divisor);
  }
}

// Painting without a graphics card: the same picture, point by point

const word = (colour) => colour.reduce((bits, value, i) => bits | Math.round(255 * value) << 8 * i, 0xff000000) >>> 0;

class SoftwarePainter {
  ratio = 1;

  constructor(canvas) {
    this.context = canvas.getContext("2d", { willReadFrequently: true });
  }

  paint(frame) {
    let picture = null;
    for (const [clouds, opacity] of frame.layers) {
      const image = this.paintLayer(frame, clouds);
      if (picture) {
        const under = picture.data, over = image.data;
        for (let i = 0; i < under.length; i++) under[i] += opacity * (over[i] - under[i]);
      } else {
        picture = image;
      }
    }
    this.context.putImageData(picture, 0, 0);
    if (!frame.lines) return;
    for (const [first, count] of frame.lines.runs) {
      for (let i = first; i < first + count; i++) this.paintLine(frame, i);
    }
    // a printer is given what was stroked anew, without the points: let it all be points
    this.context.putImageData(this.context.getImageData(0, 0, frame.width, frame.height), 0, 0);
  }

  paintLayer(frame, clouds) {
    const { width, height } = frame;
    const image = this.context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer).fill(word(frame.background));
    const layer = { pixels, depths: new Float32Array(width * height).fill(Infinity) };
    for (const cloud of clouds) this.paintPoints(frame, cloud, layer);
    this.shade(frame, layer, image.data);
    return image;
  }

  paintPoints({ width, height, near, reach, every, background }, cloud, { pixels, depths }) {
    const { points, tints, matrix: m, pale } = cloud, plain = word(mix(cloud.colour, background, pale));
    const stand = background.map((value) => 255 * pale * value), keep = 1 - pale;
    for (let i = 0; i < points.length; i += 3 * every) {
      const x = points[i], y = points[i + 1], z = points[i + 2];
      const w = m[3] * x + m[7] * y + m[11] * z + m[15];
      if (w < near) continue;
      const side = Math.max(1, Math.min(48, Math.round(reach / w + 0.25)));
      const left = Math.round((0.5 + 0.5 * (m[0] * x + m[4] * y + m[8] * z + m[12]) / w) * width - side / 2);
      const top = Math.round((0.5 - 0.5 * (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) * height - side / 2);
      let ink = plain;
      if (tints) {
        const [r, g, b] = [keep * tints[i] + stand[0], keep * tints[i + 1] + stand[1], keep * tints[i + 2] + stand[2]];
        ink = (0xff000000 | b << 16 | g << 8 | r) >>> 0;
      }
      for (let row = Math.max(0, top); row < Math.min(height, top + side); row++) {
        for (let column = Math.max(0, left); column < Math.min(width, left + side); column++) {
          const k = row * width + column;
          if (w < depths[k]) { depths[k] = w; pixels[k] = ink; }
        }
      }
    }
  }

  shade({ width }, { depths }, bytes) {
    const neighbours = [-1, 1, -width, width];
    for (let k = 0; k < depths.length; k++) {
      if (depths[k] === Infinity) continue;
      let response = 0;
      for (const step of neighbours) {
        const other = depths[k + step];
        if (other < depths[k]) response += Math.min(0.02, Math.log2(depths[k] / other));
      }
      const light = Math.exp(-18 * response);
      for (let i = 4 * k; i < 4 * k + 3; i++) bytes[i] *= light;
    }
  }

  paintLine(frame, i) {
    const { ends, tints, from, to } = frame.lines, context = this.context;
    const start = projected(from, ends.subarray(6 * i, 6 * i + 3), frame);
    const end = projected(to, ends.subarray(6 * i + 3, 6 * i + 6), frame);
    if (!start || !end) return;
    context.lineCap = "round";
    for (const [colour, thickness] of [[frame.background, 3.8], [tints.subarray(3 * i, 3 * i + 3), 2]]) {
      context.strokeStyle = css(colour);
      context.lineWidth = thickness;
      context.beginPath();
      context.moveTo(start[0], start[1]);
      context.lineTo(end[0], end[1]);
      context.stroke();
    }
  }
}

/** Whether WebGL 2 has a graphics card behind it: an emulated one is ten times slower than the software painter. */
function hasGraphicsCard() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl || location.hash === "#webgl") return Boolean(gl); // page.html#webgl takes an emulated one too
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  return !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

const Painter = hasGraphicsCard() ? WebGLPainter : SoftwarePainter;

// The views

const MOVING = 50000; // points that are painted in software while the view moves
const NEAR = 24; // pixels within which a point is picked

/**
 * Canvases that one camera looks at.
 *
 * subject(id) says what the canvas of that id shows: the radius and centre to look at, and layers [members, opacity]
 * from below. A member is {cloud, pose, place, pale}: rows that take the coordinates about the cloud's centre to where
 * they are drawn, and to where they are truly, about an origin.
 */
class Viewer {
  camera = {};
  pointers = new Map();
  travel = 0; // pixels that the pointer went since it was pressed
  marks = []; // of points to measure between: {cloud, row}
  pending = 0;
  rest = 0;

  constructor({ ids, up, clouds, subject, theme = () => {} }) {
    Object.assign(this, { up, subject, theme });
    this.views = ids.map((id) => {
      const canvas = element(id), overlay = canvas.parentElement.querySelector("svg");
      return { id, canvas, overlay, painter: new Painter(canvas, () => this.redraw()) };
    });
    const most = Math.max(1, ...clouds.map(({ points }) => points.length / 3)), { clientHeight } = this.views[0].canvas;
    element("size").value = Math.max(1.5, Math.min(6, clientHeight / Math.sqrt(most))); // closes surfaces
    element("own-choice").hidden = !clouds.some(({ tints }) => tints);
    element("warning").hidden = Painter === WebGLPainter;
    this.listen();
    this.theme();
    this.reset();
  }

  // The camera: one for all views, in units of each view's radius

  reset() {
    const steep = this.up.endsWith("z");
    Object.assign(this.camera, { yaw: steep ? -0.5 : -0.35, pitch: steep ? 0.75 : 0.2, panX: 0, panY: 0, zoom: 1 });
    element("up").value = this.up.replace("-", "−");
    this.redraw();
  }

  orbit(dx, dy) {
    this.camera.yaw += dx;
    this.camera.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, this.camera.pitch + dy));
    this.redraw();
  }

  pan(dx, dy) { // in heights of the canvas
    this.camera.panX += 2 * dx / this.camera.zoom;
    this.camera.panY -= 2 * dy / this.camera.zoom;
    this.redraw();
  }

  zoom(factor) {
    this.camera.zoom = Math.max(0.2, Math.min(200, this.camera.zoom * factor));
    this.redraw();
  }

  // Drawing

  /** All that a painter needs for one picture. */
  frame(id, width, height, ratio, every) {
    const { camera } = this, { radius, centre, layers, lines } = this.subject(id), own = element("own").checked;
    const aspect = width / height, size = Number(element("size").value) * ratio * camera.zoom;
    const distance = 1.05 * FOCAL * radius / Math.min(1, aspect) / camera.zoom;
    const near = 0.02 * distance, far = distance + 30 * radius;
    const world = chain(
      perspective(FOCAL, aspect, near, far),
      translation(radius * camera.panX, radius * camera.panY, -distance),
      turn(0, camera.pitch), turn(1, camera.yaw), UPRIGHT[element("up").value.replace("−", "-")],
      translation(...centre.map((value) => -value)),
    );
    const drawn = ({ cloud, pose, place, pale = 0 }) => ({
      cloud, place, pale, points: cloud.points, colour: cloud.colour, tints: own ? cloud.tints : null,
      matrix: chain(world, fromRows(pose), toLocal(cloud)),
    });
    return {
      width, height, ratio, near, far, every, background: themeColour("canvas"),
      reach: size * distance, // a point's diameter times its distance
      disc: Math.max(2 * ratio, Math.min(48, size) / 2),
      layers: layers.map(([members, opacity]) => [members.map(drawn), opacity]),
      lines: lines && { ...lines, from: chain(world, fromRows(lines.from)), to: chain(world, fromRows(lines.to)) },
    };
  }

  draw(every = 1) {
    for (const view of this.views) {
      const { id, canvas, painter } = view;
      const width = Math.max(1, Math.round(canvas.clientWidth * painter.ratio));
      const height = Math.max(1, Math.round(canvas.clientHeight * painter.ratio));
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      view.frame = this.frame(id, width, height, painter.ratio, every);
      painter.paint(view.frame);
      this.drawMarks(view);
    }
    this.tellMeasured();
  }

  /** Draws soon: of many points in software only some while the view moves, and all when it rests. */
  redraw() {
    this.pending ||= requestAnimationFrame(() => {
      this.pending = 0;
      const every = Painter === SoftwarePainter ? Math.max(1, Math.ceil(this.count() / MOVING)) : 1;
      this.draw(every);
      clearTimeout(this.rest);
      if (every > 1) this.rest = setTimeout(() => this.draw(), 150);
    });
  }

  count() {
    const seen = ({ id }) => this.members(this.subject(id)).reduce((sum, { cloud }) => sum + cloud.points.length / 3, 0);
    return Math.max(...this.views.map(seen));
  }

  /** What is seen of a subject or a frame: the last layer has all. */
  members({ layers }) {
    return layers[layers.length - 1][0];
  }

  // Measuring

  /** The point of a view that is nearest to pixels of the canvas: in front, where several are about as near. */
  pick({ frame, painter: { ratio } }, x, y) {
    let best = null;
    for (const { cloud, points, matrix: m } of this.members(frame)) {
      for (let i = 0; i < points.length; i += 3) {
        const w = m[3] * points[i] + m[7] * points[i + 1] + m[11] * points[i + 2] + m[15];
        if (w < frame.near) continue;
        const right = (m[0] * points[i] + m[4] * points[i + 1] + m[8] * points[i + 2] + m[12]) / w;
        const above = (m[1] * points[i] + m[5] * points[i + 1] + m[9] * points[i + 2] + m[13]) / w;
        const dx = (0.5 + 0.5 * right) * frame.width - x, dy = (0.5 - 0.5 * above) * frame.height - y;
        const away = Math.max(Math.hypot(dx, dy), frame.disc); // on the disc of a point there is none nearer
        if (away > NEAR * ratio || best && (away > best.away || away === best.away && w >= best.w)) continue;
        best = { cloud, row: i / 3, away, w };
      }
    }
    return best;
  }

  measure(view, event) {
    if (!view.frame) return; // not drawn yet
    const box = view.canvas.getBoundingClientRect(), { ratio } = view.painter;
    const found = this.pick(view, (event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio);
    if (!found) return;
    if (this.marks.length === 2) this.marks = [];
    this.marks.push({ cloud: found.cloud, row: found.row });
    this.redraw();
  }

  /** Where a mark is in a view: in pixels, and truly, about the view's origin; null where its cloud is not shown. */
  located({ frame, canvas }, { cloud, row }) {
    const member = this.members(frame).find((each) => each.cloud === cloud);
    if (!member) return null;
    const point = cloud.points.subarray(3 * row, 3 * row + 3), spot = projected(member.matrix, point, frame);
    const scale = canvas.clientWidth / frame.width;
    return {
      spot: spot && [spot[0] * scale, spot[1] * scale],
      place: moved(chain(fromRows(member.place), toLocal(cloud)), point),
    };
  }

  /** Decimals that mean something: coordinates are exact to half a step. */
  decimals() {
    const step = Math.max(...this.marks.map(({ cloud }) => cloud.step));
    return Math.max(0, Math.min(9, Math.ceil(-Math.log10(step))));
  }

  written(value) {
    const digits = { minimumFractionDigits: this.decimals(), maximumFractionDigits: this.decimals() };
    return value.toLocaleString("en", digits).replace("-", "−");
  }

  drawMarks(view) {
    const found = this.marks.map((mark) => this.located(view, mark)).filter((each) => each && each.spot);
    const shape = (name, attributes, text = "") => {
      const made = document.createElementNS(view.overlay.namespaceURI, name);
      for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
      made.textContent = text;
      return made;
    };
    view.overlay.replaceChildren();
    view.overlay.setAttribute("viewBox", `0 0 ${view.canvas.clientWidth} ${view.canvas.clientHeight}`);
    if (found.length === 2) {
      const [[x1, y1], [x2, y2]] = found.map(({ spot }) => spot);
      const length = Math.hypot(...found[0].place.map((value, i) => found[1].place[i] - value));
      view.overlay.append(
        shape("line", { x1, y1, x2, y2 }),
        shape("text", { x: (x1 + x2) / 2 + 8, y: (y1 + y2) / 2 - 8 }, this.written(length)),
      );
    }
    for (const { spot: [cx, cy] } of found) view.overlay.append(shape("circle", { cx, cy, r: 5 }));
  }

  /** Says in words what is measured: the distance in each view, and along the axes in the last. */
  tellMeasured() {
    const told = element("measured"), unit = told.dataset.unit;
    told.hidden = !element("measure").checked && !this.marks.length;
    if (this.marks.length < 2) {
      told.textContent = this.marks.length ? "Click the second point." : "Click two points.";
      return;
    }
    const parts = this.views.flatMap((view) => {
      const places = this.marks.map((mark) => this.located(view, mark)?.place);
      if (!places[0] || !places[1]) return [];
      const along = places[0].map((value, i) => places[1][i] - value);
      const axes = along.map((value, i) => `Δ${"xyz"[i]} ${this.written(value)}`).join(", ");
      return [`${view.id} ${this.written(Math.hypot(...along))} (${axes})`];
    });
    const [from, to] = this.marks.map(({ cloud }) => cloud.name);
    told.textContent = `Distance from ${from} to ${to}, in ${unit}: ${parts.join("; ")}.`;
  }

  // Pointer, wheel, keyboard and printer

  dragged(event) {
    const { pointers } = this, last = pointers.get(event.pointerId);
    if (!last) return;
    const height = event.currentTarget.clientHeight;
    const dx = event.clientX - last.x, dy = event.clientY - last.y;
    this.travel += Math.abs(dx) + Math.abs(dy);
    if (pointers.size > 1) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      const span = (x, y) => Math.max(1, Math.hypot(x - other.x, y - other.y));
      this.zoom(span(event.clientX, event.clientY) / span(last.x, last.y));
      this.pan(dx / 2 / height, dy / 2 / height); // half of what the fingers move, for their midpoint
    } else if (event.shiftKey || event.buttons & 6) {
      this.pan(dx / height, dy / height);
    } else {
      this.orbit(4 * dx / height, 4 * dy / height);
    }
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  pressed(event) {
    const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] || [0, 0];
    if (dx || dy) (event.shiftKey ? this.pan : this.orbit).call(this, 0.08 * dx, 0.08 * dy);
    else if (event.key === "+" || event.key === "=") this.zoom(1.15);
    else if (event.key === "-") this.zoom(1 / 1.15);
    else if (event.key === "0") this.reset();
    else if (event.key === "m") element("measure").click();
    else return;
    event.preventDefault();
  }

  listen() {
    for (const view of this.views) {
      const { canvas } = view;
      canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        if (!this.pointers.size) this.travel = 0;
        this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      });
      canvas.addEventListener("pointermove", (event) => this.dragged(event));
      canvas.addEventListener("pointerup", (event) => {
        const alone = this.pointers.size === 1;
        this.pointers.delete(event.pointerId);
        if (alone && this.travel < 5 && element("measure").checked) this.measure(view, event);
      });
      canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
      canvas.addEventListener("wheel", (event) => {
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : event.deltaMode ? 0.05 : 0.0015)));
      }, { passive: false });
      canvas.addEventListener("contextmenu", (event) => event.preventDefault());
      canvas.addEventListener("dblclick", () => { if (!element("measure").checked) this.reset(); });
      canvas.addEventListener("keydown", (event) => this.pressed(event));
      new ResizeObserver(() => this.redraw()).observe(canvas);
    }
    element("measure").addEventListener("change", ({ target }) => {
      document.body.classList.toggle("measuring", target.checked);
      this.marks = [];
    });
    element("reset").addEventListener("click", () => this.reset());
    element("print").addEventListener("click", () => print());
    element("controls").addEventListener("input", () => this.redraw());
    element("controls").addEventListener("submit", (event) => event.preventDefault());
    const again = () => { this.theme(); this.redraw(); };
    darkTheme.addEventListener("change", again);
    addEventListener("beforeprint", () => { // on paper the theme is the light one
      document.documentElement.classList.add("printing");
      this.theme();
      this.draw();
    });
    addEventListener("afterprint", () => { document.documentElement.classList.remove("printing"); again(); });
  }
}
