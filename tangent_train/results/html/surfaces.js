// What draws: WebGL 2, or where there is none the flat image on an ordinary canvas.

const LAYERS = ["input", "truth", "prediction", "error", "overlay", "confidence"];
const MAPS = ["truth", "prediction", "confidence"];
const WRONG = [214, 39, 40];
const UNLABELED = [136, 136, 136];
const UNSURE = [94, 60, 153];
const WORST = Math.log(1.25); // relative error of a distance that is wholly red

async function decode(base64, type, mostPixels) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  const blob = new Blob([bytes], { type });
  // Class indices and distances must arrive as they are in the file.
  const exact = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
  const whole = await createImageBitmap(blob, exact);
  const shrink = mostPixels / Math.max(whole.width, whole.height);
  if (shrink >= 1) return whole;
  const resizeWidth = Math.max(1, Math.floor(whole.width * shrink));
  const resizeHeight = Math.max(1, Math.floor(whole.height * shrink));
  whole.close();
  const resizeQuality = type === "image/png" ? "pixelated" : "high";
  return createImageBitmap(blob, { ...exact, resizeWidth, resizeHeight, resizeQuality });
}

async function decodeImage(data, mostPixels) {
  const image = { input: await decode(data.input, "image/jpeg", mostPixels) };
  for (const kind of MAPS) {
    image[kind] = data[kind] ? await decode(data[kind], "image/png", mostPixels) : null;
  }
  return image;
}

function mix(a, b, share) {
  return a.map((value, k) => value + share * (b[k] - value));
}

function pixelAt(u, v, width, height) {
  return [Math.floor(u * width) % width, Math.min(Math.floor(v * height), height - 1)];
}

class GlSurface {
  static open(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    return gl ? new GlSurface(gl) : null;
  }

  constructor(gl) {
    this.gl = gl;
    this.projections = ["inside", "planet", "flat"];
    this.build();
  }

  // Everything the context holds: again after it was lost.
  build() {
    const { gl } = this;
    this.mostPixels = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.textures = {};
    const source = document.getElementById("shader").textContent;
    // One triangle that covers the canvas.
    const corners = `void main() {
      gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1);
    }`;
    this.image = this.link(corners, source);
    const points = `#define POINTS\n${source}`;
    this.points = this.link(`#define VERTEX\n${points}`, points);
    gl.disable(gl.DITHER); // colors of points are numbers
    this.framebuffer = gl.createFramebuffer();
    ["input", ...MAPS, "colors"].forEach((name, unit) => {
      this.textures[name] = this.texture(unit);
      this.set("uniform1i", `u${name[0].toUpperCase()}${name.slice(1)}`, unit);
    });
  }

  link(vertices, fragments) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertices], [gl.FRAGMENT_SHADER, fragments]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, `#version 300 es\n${source}`);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(`The viewer's shader: ${logs.join(" ")} ${gl.getProgramInfoLog(program)}`);
    }
    return program;
  }

  texture(unit) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return texture;
  }

  // In both programs, as far as they use it.
  set(method, name, ...values) {
    const { gl } = this;
    for (const program of [this.image, this.points]) {
      gl.useProgram(program);
      gl[method](gl.getUniformLocation(program, name), ...values);
    }
  }

  load(image, sphere, distances) {
    const { gl } = this;
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.activeTexture(gl.TEXTURE0);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image.input);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, sphere ? gl.REPEAT : gl.CLAMP_TO_EDGE);
    this.set("uniform1i", "uSphere", sphere);
    this.set("uniform1i", "uHasTruth", image.truth !== null);
    this.set("uniform1i", "uHasPrediction", image.prediction !== null);
    this.set("uniform1i", "uHasDistances", distances !== null);
    if (distances) this.set("uniform4f", "uScale", ...distances.logs);
    if (distances?.camera) this.set("uniform4f", "uCamera", ...distances.camera);
    this.sizes = {};
    MAPS.forEach((kind, k) => {
      gl.activeTexture(gl.TEXTURE1 + k);
      const map = image[kind] ?? new ImageData(1, 1);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, map);
      this.sizes[kind] = image[kind] && [map.width, map.height];
    });
    for (const bitmap of Object.values(image)) bitmap?.close();
  }

  paint(colors, hidden) {
    const { gl } = this;
    const entries = new Uint8Array(4 * 256);
    colors.forEach((rgb, k) => entries.set([...rgb, hidden.has(k) ? 0 : 255], 4 * k));
    gl.activeTexture(gl.TEXTURE1 + MAPS.length);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, entries);
  }

  draw(view, layer, opacity, swipe, pointer) {
    const { gl } = this;
    gl.viewport(0, 0, gl.canvas.width, gl.canvas.height);
    this.set("uniform2f", "uCanvas", gl.canvas.width, gl.canvas.height);
    this.set("uniform1f", "uReach", view.reach);
    this.set("uniform1f", "uOpacity", opacity);
    this.set("uniform1f", "uSwipe", swipe);
    this.set("uniform1i", "uLayer", LAYERS.indexOf(layer));
    if (view instanceof Scene) {
      this.drawPoints(view, layer === "truth" || !this.sizes.prediction, pointer);
      return;
    }
    this.set("uniform2f", "uCenter", view.u, view.v);
    this.set("uniform1f", "uAspect", view.image.aspect);
    this.set("uniform1i", "uProjection", PROJECTIONS[view.projection].index);
    gl.useProgram(this.image);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Without buffers: a vertex computes its place from its number.
  drawPoints({ axes, eye, radius, canvas }, byTruth, pointer) {
    const { gl } = this;
    for (const [name, vector] of Object.entries({ eye, ...axes })) {
      this.set("uniform3f", `u${name[0].toUpperCase()}${name.slice(1)}`, ...vector);
    }
    this.set("uniform1f", "uNear", 0.002 * radius);
    this.set("uniform1i", "uByTruth", byTruth);
    const [width, height] = this.sizes[byTruth ? "truth" : "prediction"];
    const draw = (pick, ...background) => {
      this.set("uniform1i", "uPick", pick);
      gl.useProgram(this.points);
      gl.clearColor(...background, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.drawArrays(gl.POINTS, 0, width * height);
    };
    gl.enable(gl.DEPTH_TEST);
    // Which point is at the pointer: this pixel, in the colors of the points' numbers.
    const [x, y] = pointer ?? canvas.map((side) => side / 2);
    const column = Math.floor((x / canvas[0]) * gl.canvas.width);
    const row = gl.canvas.height - 1 - Math.floor((y / canvas[1]) * gl.canvas.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(column, row, 1, 1);
    draw(true, 0, 0, 0);
    gl.disable(gl.SCISSOR_TEST);
    const pixel = new Uint8Array(4);
    gl.readPixels(column, row, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    const number = pixel[0] + 256 * pixel[1] + 65536 * pixel[2] - 1;
    const [u, v] = [(number % width) + 0.5, Math.floor(number / width) + 0.5];
    this.picked = number < 0 ? null : { u: u / width, v: v / height };
    draw(false, 0.086, 0.094, 0.11);
    gl.disable(gl.DEPTH_TEST);
  }

  // Red and green of a map at {u, v}, read back from the texture; null without such a map.
  valueAt(kind, { u, v }) {
    const { gl } = this;
    if (!this.sizes?.[kind]) return null;
    const [width, height] = this.sizes[kind];
    const pixel = new Uint8Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    const target = [gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D];
    gl.framebufferTexture2D(...target, this.textures[kind], 0);
    const [column, row] = pixelAt(u, v, width, height);
    gl.readPixels(column, row, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return pixel;
  }
}

class FlatSurface {
  constructor(canvas) {
    this.context = canvas.getContext("2d");
    this.projections = ["flat"];
    this.mostPixels = 1024;
  }

  load(image, sphere, distances) {
    this.distances = distances;
    const [width, height] = [image.input.width, image.input.height];
    this.sheet = new OffscreenCanvas(width, height);
    this.pixels = {};
    for (const [kind, bitmap] of Object.entries(image)) {
      if (!bitmap) continue;
      const settings = { willReadFrequently: true };
      const scratch = new OffscreenCanvas(width, height).getContext("2d", settings);
      scratch.imageSmoothingEnabled = false;
      scratch.drawImage(bitmap, 0, 0, width, height);
      if (kind === "input") this.photo = scratch.canvas;
      this.pixels[kind] = scratch.getImageData(0, 0, width, height).data;
      bitmap.close();
    }
    this.painted = null;
  }

  paint(colors, hidden) {
    [this.colors, this.hidden, this.painted] = [colors, hidden, null];
  }

  draw(view, layer, opacity, swipe) {
    const { context } = this;
    const { canvas } = context;
    if (this.painted !== layer + opacity) this.compose(layer, opacity);
    this.painted = layer + opacity;
    const width = Math.max(canvas.width, canvas.height) / view.extent;
    const height = width / view.image.aspect;
    const left = canvas.width / 2 - view.u * width;
    context.fillStyle = "#16181c";
    context.fillRect(0, 0, canvas.width, canvas.height);
    const top = canvas.height / 2 - view.v * height;
    const divider = layer === "input" ? 0 : swipe * canvas.width;
    for (const [sheet, from, to] of [[this.photo, 0, divider], [this.sheet, divider, canvas.width]]) {
      context.save();
      context.beginPath();
      context.rect(from, 0, to - from, canvas.height);
      context.clip();
      for (const turn of view.image.sphere ? [-1, 0, 1] : [0]) {
        context.drawImage(sheet, left + turn * width, top, width, height);
      }
      context.restore();
    }
  }

  compose(layer, opacity) {
    const { input } = this.pixels;
    const result = new ImageData(this.sheet.width, this.sheet.height);
    const shown = this.distances ? this.ofDistances : this.ofLabels;
    for (let k = 0; k < input.length; k += 4) {
      const under = [input[k], input[k + 1], input[k + 2]];
      const values = MAPS.map((kind) => this.pixels[kind]?.subarray(k, k + 2));
      const strength = this.isOutline(k) ? Math.min(2.5 * opacity, 1) : opacity;
      const color = layer === "input" ? under : shown.call(this, layer, strength, under, ...values);
      result.data.set([...color, 255], k);
    }
    this.sheet.getContext("2d").putImageData(result, 0, 0);
  }

  isOutline(k) {
    const map = this.distances ? [] : (this.pixels.prediction ?? this.pixels.truth ?? []);
    const differs = (step) => map[k] !== map[k + step] || map[k + 1] !== map[k + step + 1];
    return [4, 4 * this.sheet.width].some((step) => k + step < map.length && differs(step));
  }

  // One pixel, as in the shader.
  ofLabels(layer, opacity, under, [truth] = [0], [prediction] = [truth], [sure] = [0]) {
    const index = layer === "truth" || layer === "error" ? truth : prediction;
    const visible = !this.hidden.has(index);
    const gray = 0.299 * under[0] + 0.587 * under[1] + 0.114 * under[2];
    if (layer === "overlay") return visible && index ? mix(under, this.colors[index], opacity) : under;
    const pale = Array(3).fill(191.25 + 0.25 * gray);
    if (layer === "confidence") return prediction ? mix(UNSURE, pale, sure / 255) : UNLABELED;
    if (!visible) return Array(3).fill(0.4 * gray);
    if (layer !== "error") return this.colors[index];
    if (!truth) return UNLABELED;
    return truth === prediction ? pale : WRONG;
  }

  ofDistances(layer, opacity, under, ...values) {
    const [truth, prediction] = values.map((bytes) => (bytes ? this.distances.log(...bytes) : null));
    const gray = 0.299 * under[0] + 0.587 * under[1] + 0.114 * under[2];
    if (layer === "error") {
      if (truth === null || prediction === null) return UNLABELED;
      const share = Math.min(Math.abs(prediction - truth) / WORST, 1);
      return mix(Array(3).fill(191.25 + 0.25 * gray), WRONG, share);
    }
    const log = layer === "truth" || !values[1] ? truth : prediction;
    if (log === null) return layer === "overlay" ? under : Array(3).fill(0.4 * gray);
    const color = this.distances.color(log);
    return layer === "overlay" ? mix(under, color, opacity) : color;
  }

  valueAt(kind, { u, v }) {
    if (!this.pixels?.[kind]) return null;
    const { width, height } = this.sheet;
    const [column, row] = pixelAt(u, v, width, height);
    return this.pixels[kind].subarray(4 * (row * width + column));
  }
}
