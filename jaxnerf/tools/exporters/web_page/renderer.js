// Reads a scene and renders it with WebGL 2. A frame is drawn in strips of rows, each small enough that the GPU never
// blocks for long, into a texture, which is then shown on the canvas.
"use strict";

const MAGIC = "JAXNERF1";
const STRIP_MS = 24;       // what a strip should take
const FIRST_PIXELS = 2048; // of the first strip, before a speed is known
const SPEED_KEPT = 0.5;    // weight of the older measurements of the speed

const COPY_VERTEX = `#version 300 es
void main() {
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1));
  gl_Position = vec4(4.0 * corner - 1.0, 0.0, 1.0);
}`;
const COPY_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D image;
uniform vec2 size;  // px of the canvas
out vec4 color;
void main() { color = texture(image, gl_FragCoord.xy / size); }`;

// Returns {content, arrays} of the bytes of a scene; an Error says what is wrong with them.
async function decodeScene(bytes) {
  let raw;
  try {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    raw = await new Response(stream).arrayBuffer();
  } catch (error) {
    throw new Error("The scene's data is damaged or incomplete. Download or export it again.");
  }
  const view = new DataView(raw);
  const magic = String.fromCharCode(...new Uint8Array(raw, 0, Math.min(8, raw.byteLength)));
  if (magic !== MAGIC) throw new Error(`The data begins with "${magic}", expected ${MAGIC}: it is no scene of this page.`);
  const length = view.getUint32(8, true), start = 12 + length;
  const content = JSON.parse(new TextDecoder().decode(new Uint8Array(raw, 12, length)));
  if (raw.byteLength !== start + content.bytes) throw new Error("The scene's data has another length than it states.");
  const types = {u8: [Uint8Array, 4], f16: [Uint16Array, 4], f32: [Float32Array, 4], u32: [Uint32Array, 1]};
  const arrays = {};
  for (const array of content.arrays) {
    const [type, channels] = types[array.type];
    const numbers = new type(raw, start + array.start, array.width * array.height * channels);
    arrays[array.name] = {...array, numbers};
  }
  return {content, arrays};
}

class Renderer {
  // canvas: on which frames are shown; scene: of decodeScene; report: called with an Error when the GPU is lost.
  constructor(canvas, scene, report) {
    this.canvas = canvas;
    this.scene = scene;
    this.pixelsPerMs = 0;
    this.frame = null;     // that is being drawn
    this.fence = null;
    this.lost = false;
    this.onLost = (event) => {
      event.preventDefault();
      this.lost = true;
      this.drop();
      report("The graphics device was lost; waiting for it.");
    };
    this.onRestored = () => {
      this.lost = false;
      this.prepare();
      report("");
    };
    canvas.addEventListener("webglcontextlost", this.onLost);
    canvas.addEventListener("webglcontextrestored", this.onRestored);
    this.prepare();
  }

  prepare() {
    const gl = this.canvas.getContext("webgl2", {alpha: false, antialias: false, powerPreference: "high-performance"});
    if (!gl) throw new Error("This browser has no WebGL 2, or it is switched off.");
    this.gl = gl;
    const largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    for (const array of this.scene.content.arrays) {
      if (array.width > largest || array.height > largest) {
        throw new Error(`The scene needs textures of ${array.width} x ${array.height}; this device has ${largest}.`);
      }
    }
    this.march = this.program(COPY_VERTEX, this.scene.content.shader);
    this.copy = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.textures = Object.values(this.scene.arrays).map((array) => this.upload(array));
    this.target = null;
    this.vertices = gl.createVertexArray();
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      gl.deleteShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error("A shader does not compile: " + gl.getShaderInfoLog(shader));
      }
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error("The shaders do not link: " + gl.getProgramInfoLog(program));
    }
    const names = {}, count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
    for (let index = 0; index < count; ++index) {
      const name = gl.getActiveUniform(program, index).name;
      names[name] = gl.getUniformLocation(program, name);
    }
    return {program, names};
  }

  // Replaces the scene by another state of the same training; its frame is dropped.
  replace(scene) {
    const gl = this.gl, before = this.scene.content.shader;
    this.drop();
    this.scene = scene;
    if (this.lost) return;
    this.textures.forEach(({texture}) => gl.deleteTexture(texture));
    this.textures = Object.values(scene.arrays).map((array) => this.upload(array));
    if (scene.content.shader === before) return;
    gl.deleteProgram(this.march.program);
    this.march = this.program(COPY_VERTEX, scene.content.shader);
  }

  upload(array) {
    const gl = this.gl, texture = gl.createTexture();
    const formats = {
      u8: [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE], f16: [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT],
      f32: [gl.RGBA32F, gl.RGBA, gl.FLOAT], u32: [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT],
    };
    const [inside, format, type] = formats[array.type];
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, inside, array.width, array.height);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, array.width, array.height, format, type, array.numbers);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return {name: array.name, texture};
  }

  // Begins a frame. view: {pose: 12 numbers by rows, focal, center: px, width, height, near, far, shown, range}.
  begin(view) {
    this.drop();
    this.frame = {view, row: 0};
  }

  drop() {
    if (this.fence) this.gl.deleteSync(this.fence.sync);
    this.fence = this.frame = null;
  }

  // Draws the next strip if the last one is finished. Returns whether the frame is complete.
  advance() {
    if (this.lost || !this.frame) return false;
    const gl = this.gl, now = performance.now();
    if (this.fence) {
      if (gl.getSyncParameter(this.fence.sync, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
      gl.deleteSync(this.fence.sync);
      const speed = this.fence.pixels / Math.max(now - this.fence.since, 0.5);
      this.pixelsPerMs = this.pixelsPerMs ? SPEED_KEPT * this.pixelsPerMs + (1 - SPEED_KEPT) * speed : speed;
      this.fence = null;
    }
    const {view, row} = this.frame;
    if (row >= view.height) return true;
    const pixels = this.pixelsPerMs ? this.pixelsPerMs * STRIP_MS : FIRST_PIXELS;
    const rows = Math.min(Math.max(Math.floor(pixels / view.width), 1), view.height - row);
    this.strip(view, row, rows);
    this.frame.row += rows;
    this.fence = {sync: gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), pixels: rows * view.width, since: now};
    gl.flush();
    return false;
  }

  strip(view, row, rows) {
    const gl = this.gl, {program, names} = this.march, p = view.pose;
    this.resize(view.width, view.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, view.width, view.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, view.height - row - rows, view.width, rows);
    gl.useProgram(program);
    this.textures.forEach(({name, texture}, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(names[name], unit);
    });
    gl.uniform3f(names.eye, p[3], p[7], p[11]);
    gl.uniformMatrix3fv(names.turn, false, [p[0], p[4], p[8], p[1], p[5], p[9], p[2], p[6], p[10]]);
    gl.uniform2fv(names.focal, view.focal);
    gl.uniform2fv(names.center, view.center);
    gl.uniform1f(names.image_height, view.height);
    gl.uniform1f(names.near, view.near);
    gl.uniform1f(names.far, view.far);
    gl.uniform2fv(names.ndc_scale, this.scene.content.ndc_scale || [1, 1]);
    gl.uniform1i(names.shown, view.shown || 0);
    gl.uniform2fv(names.depth_range, view.range || [view.near, view.far]);
    this.fill();
  }

  fill() {
    this.gl.bindVertexArray(this.vertices);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }

  resize(width, height) {
    const gl = this.gl;
    if (this.target && this.target.width === width && this.target.height === height) return;
    this.free();
    const texture = gl.createTexture(), framebuffer = gl.createFramebuffer();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = {texture, framebuffer, width, height};
  }

  free() {
    if (!this.target) return;
    this.gl.deleteTexture(this.target.texture);
    this.gl.deleteFramebuffer(this.target.framebuffer);
    this.target = null;
  }

  // Shows the frame on the canvas.
  present() {
    const gl = this.gl, {width, height} = this.canvas;
    if (!this.target) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.SCISSOR_TEST);
    gl.useProgram(this.copy.program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(this.copy.names.image, 0);
    gl.uniform2f(this.copy.names.size, width, height);
    this.fill();
  }

  // Returns the pixels of the frame that was drawn last, RGBA, from the top row.
  pixels() {
    const gl = this.gl, {width, height, framebuffer} = this.target;
    const found = new Uint8Array(width * height * 4), flipped = new Uint8Array(found.length);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, found);
    for (let row = 0; row < height; ++row) {
      flipped.set(found.subarray(4 * width * row, 4 * width * (row + 1)), 4 * width * (height - 1 - row));
    }
    return flipped;
  }

  // Frees everything on the GPU.
  close() {
    this.drop();
    this.free();
    const gl = this.gl;
    this.textures.forEach(({texture}) => gl.deleteTexture(texture));
    gl.deleteVertexArray(this.vertices);
    [this.march, this.copy].forEach(({program}) => gl.deleteProgram(program));
    this.canvas.removeEventListener("webglcontextlost", this.onLost);
    this.canvas.removeEventListener("webglcontextrestored", this.onRestored);
  }
}
