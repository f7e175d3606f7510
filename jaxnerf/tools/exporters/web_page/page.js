// The page: it loads the scene, and redraws it when the camera or the window changes. While the camera moves, the
// resolution is such that a frame takes FRAME_MS; when it rests, the frame is drawn again with twice the resolution, up
// to that of the window.
"use strict";

const FRAME_MS = 33, MIN_PIXELS = 3000;
const TURN = 0.006, KEY_TURN = 0.06, KEY_MOVE = 0.04, WHEEL = 0.0012;  // radians per px or key; distances; per wheel unit
const TOUR_FRAMES_PER_SECOND = 8;
const POLL_MS = 2000;  // between requests for newer parameters of a viewer
const element = (id) => document.getElementById(id);
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;  // the tour then jumps from camera to camera

function say(text) { element("message").textContent = text; }

async function loadBytes() {
  const holder = element("scene"), text = holder.textContent.trim();
  if (holder.dataset.kind === "file") {
    const advice = "The page reads it from a web server only, not from a folder.";
    const answer = await fetch(text).catch(() => { throw new Error(`${text} cannot be read. ${advice}`); });
    if (!answer.ok) throw new Error(`${text} cannot be read: ${answer.status}. Put it beside this page.`);
    return answer.arrayBuffer();
  }
  holder.textContent = "";  // the text takes as much memory as the scene
  let binary;
  try { binary = atob(text); } catch (error) { throw new Error("The scene's data is damaged. Export it again."); }
  return Uint8Array.from(binary, (letter) => letter.charCodeAt(0));
}

// Returns the scene of the viewer, if its step is another than this one; otherwise null.
async function newerScene(step) {
  const answer = await fetch(`scene.bin?step=${step}`).catch(() => { throw new Error("The viewer does not answer."); });
  if (answer.status === 204) return null;
  if (!answer.ok) throw new Error(await answer.text());
  return decodeScene(await answer.arrayBuffer());
}

const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

// Returns whether the browser has WebGL 2 on a graphics device: in software, a frame takes seconds.
function hasDevice() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  const ending = gl.getExtension("WEBGL_lose_context");
  if (ending) ending.loseContext();
  return !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

class Page {
  constructor(scene) {
    this.content = scene.content;
    this.canvas = element("view");
    this.renderer = new Renderer(this.canvas, scene, (text) => { say(text); this.redraw(); });
    const {cameras, tour, target, up, swing} = this.content;
    this.lens = cameras[0];  // its image is shown whole
    this.camera = new OrbitCamera(tour[0], target, up, swing);
    this.shown = 0;
    this.tourTime = null;
    this.changed = true;   // the frame that is shown is not that of the camera
    this.scale = 1;        // of the last frame, over the canvas's resolution
    this.refining = false; // the frame that is drawn repeats one that is shown
    this.heldUp = null;    // a frame that the caller of `render` waits for
    this.fill();
    this.listen();
    this.readFragment();
    this.resize();
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(this.canvas);
    this.request = requestAnimationFrame((now) => this.tick(now));
  }

  fill() {
    const {name, how, cameras} = this.content;
    document.title = name;
    element("name").textContent = name;
    element("how").textContent = how;
    cameras.forEach((camera, index) => element("camera").add(new Option(camera.name, index)));
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.max(Math.round(this.canvas.clientWidth * ratio), 1);
    const height = Math.max(Math.round(this.canvas.clientHeight * ratio), 1);
    if (width === this.canvas.width && height === this.canvas.height) return;
    this.canvas.width = width;
    this.canvas.height = height;
    if (!this.renderer.lost) this.renderer.present();  // a new size clears the canvas
    this.redraw();
  }

  redraw() { this.changed = true; }

  // Called when the user moves the camera.
  moved() {
    this.stopTour();
    element("camera").value = "";
    this.redraw();
  }

  // Returns the view of the camera at a fraction of the canvas's resolution.
  view(scale) {
    const width = Math.max(Math.round(this.canvas.width * scale), 1);
    const height = Math.max(Math.round(this.canvas.height * scale), 1);
    // The whole of the dataset's image is in the window, also where that is narrow.
    const lens = this.lens, ratio = Math.min(width / lens.width, height / lens.height);
    const focal = times(lens.focal, ratio);
    const center = [width / 2 + ratio * (lens.center[0] - lens.width / 2),
                    height / 2 + ratio * (lens.center[1] - lens.height / 2)];
    const {near, far} = this.content, range = [near, Math.min(far, near + 3 * this.camera.distance)];
    return {pose: this.camera.pose, focal, center, width, height, near, far, shown: this.shown, range};
  }

  // Shows newer parameters of the viewer as they come. Until their frame is complete, the one before is shown.
  async follow() {
    while (!this.closed) {
      await wait(POLL_MS);
      if (this.heldUp || (this.refining && this.renderer.frame)) continue;
      try {
        const scene = await newerScene(this.content.step);
        if (this.closed || this.heldUp) continue;
        if (scene) this.replace(scene);
        if (element("message").textContent) this.redraw();  // the viewer answers again
      } catch (error) {
        say(`${error.message} Waiting for it.`);
      }
    }
  }

  replace(scene) {
    this.content = scene.content;
    element("how").textContent = scene.content.how;
    this.renderer.replace(scene);
    this.start(performance.now(), this.scale, true);
  }

  tick(now) {
    this.request = requestAnimationFrame((later) => this.tick(later));
    if (this.heldUp) {
      if (this.renderer.advance()) this.finish();
      return;
    }
    this.fly(now);
    if (this.renderer.advance()) {
      this.renderer.present();
      this.report(now);
      this.renderer.drop();
    }
    const busy = this.renderer.frame !== null;
    if (this.changed && (!busy || this.refining)) {
      // A moving frame is finished before the next begins, so that something is always shown.
      const pixels = this.canvas.width * this.canvas.height;
      const most = Math.max((this.renderer.pixelsPerMs || 100) * FRAME_MS, MIN_PIXELS);
      this.start(now, Math.min(1, Math.sqrt(most / pixels)), false);
    } else if (!busy && this.scale < 1 && !this.renderer.lost) {
      this.start(now, Math.min(1, 2 * this.scale), true);
    }
  }

  start(now, scale, refining) {
    this.changed = false;
    Object.assign(this, {scale, refining, began: now});
    this.renderer.begin(this.view(scale));
  }

  report(now) {
    const {width, height} = this.renderer.frame.view;
    element("speed").textContent = `${width} × ${height} px in ${Math.max(Math.round(now - this.began), 0)} ms`;
    say("");
  }

  // Renders one view and returns its pixels, RGBA from the top row: for tests, and for other scripts of a page.
  render(view) {
    return new Promise((resolve) => {
      this.heldUp = resolve;
      this.renderer.begin(view);
    });
  }

  finish() {
    const pixels = this.renderer.pixels(), resolve = this.heldUp;
    this.heldUp = null;
    this.renderer.drop();
    this.redraw();
    resolve(pixels);
  }

  // The tour

  fly(now) {
    if (this.tourTime === null) return;
    const {tour} = this.content, place = ((now - this.tourTime) / 1000 * TOUR_FRAMES_PER_SECOND) % tour.length;
    const index = Math.floor(place), next = (index + 1) % tour.length;
    const jump = calm || next === 0;
    const pose = jump ? tour[index - index % (calm ? TOUR_FRAMES_PER_SECOND : 1)] : between(tour[index], tour[next], place - index);
    if (String(pose) !== String(this.camera.pose)) {
      this.camera.set(pose, this.content.target);
      this.redraw();
    }
  }

  stopTour() {
    this.tourTime = null;
    element("tour").setAttribute("aria-pressed", "false");
  }

  // The fragment: the camera's pose, its distance and what is shown

  readFragment() {
    const numbers = location.hash.slice(1).split(",").map(Number);
    if (numbers.length !== 14 || !numbers.every(Number.isFinite)) return;
    this.camera.set(numbers.slice(0, 12));
    this.camera.distance = Math.max(numbers[12], 1e-3);
    this.shown = [0, 1, 2].includes(numbers[13]) ? numbers[13] : 0;
    element("shown").value = this.shown;
    this.redraw();
  }

  link() {
    const numbers = [...this.camera.pose, this.camera.distance].map((value) => Number(value.toPrecision(6)));
    return location.href.split("#")[0] + "#" + [...numbers, this.shown].join(",");
  }

  async share() {
    const link = this.link();
    history.replaceState(null, "", link);
    const copied = await (navigator.clipboard ? navigator.clipboard.writeText(link) : Promise.reject()).then(
      () => true, () => false);
    element("share").textContent = copied ? "Copied" : "See address bar";
    setTimeout(() => { element("share").textContent = "Copy link"; }, 2000);
  }

  // Input

  listen() {
    this.stop = new AbortController();
    const {signal} = this.stop, canvas = this.canvas, pointers = new Map();
    const on = (target, name, call) => target.addEventListener(name, call, {signal, passive: false});
    on(canvas, "pointerdown", (event) => {
      try { canvas.setPointerCapture(event.pointerId); } catch (error) { /* it has ended already */ }
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const name of ["pointerup", "pointercancel"]) on(canvas, name, (event) => pointers.delete(event.pointerId));
    on(canvas, "pointermove", (event) => this.drag(event, pointers));
    on(canvas, "wheel", (event) => {
      event.preventDefault();
      this.camera.zoom(Math.exp(WHEEL * event.deltaY));
      this.moved();
    });
    on(canvas, "contextmenu", (event) => event.preventDefault());
    on(canvas, "keydown", (event) => this.press(event));
    on(window, "hashchange", () => this.readFragment());
    on(element("shown"), "change", (event) => { this.shown = Number(event.target.value); this.redraw(); });
    on(element("camera"), "change", (event) => {
      const camera = this.content.cameras[event.target.value];
      this.stopTour();
      if (camera) {
        this.lens = camera;
        this.camera.set(camera.pose, this.content.target);
      }
      this.redraw();
    });
    on(element("tour"), "click", () => {
      const starts = this.tourTime === null;
      this.moved();
      if (starts) [this.tourTime, this.lens] = [performance.now(), this.content.cameras[0]];
      element("tour").setAttribute("aria-pressed", String(starts));
    });
    on(element("share"), "click", () => this.share());
    on(element("full"), "click", () => {
      const change = document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen();
      change.catch(() => say(""));
    });
    on(window, "pagehide", (event) => { if (!event.persisted) this.close(); });
  }

  // One pointer turns; with the right button or Shift it moves; two pointers zoom and move.
  drag(event, pointers) {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const here = [event.clientX, event.clientY], by = [here[0] - last[0], here[1] - last[1]];
    const other = [...pointers].find(([id]) => id !== event.pointerId);
    pointers.set(event.pointerId, here);
    const {height, focal} = this.lens, size = height / focal[1] / this.canvas.clientHeight;
    if (other) {
      const apart = (point) => Math.hypot(point[0] - other[1][0], point[1] - other[1][1]) || 1;
      this.camera.zoom(apart(last) / apart(here));
      this.camera.move(-by[0] * size / 2, by[1] * size / 2, 0);
    } else if (event.shiftKey || event.buttons & 2) {
      this.camera.move(-by[0] * size, by[1] * size, 0);
    } else if (element("drag").value === "orbit") {
      this.camera.orbit(by[0] * TURN, by[1] * TURN);
    } else {
      this.camera.look(-by[0] * TURN / 2, -by[1] * TURN / 2);
    }
    this.moved();
  }

  press(event) {
    const turn = (x, y) => element("drag").value === "orbit" ? this.camera.orbit(x, y) : this.camera.look(-x, -y);
    const keys = {
      ArrowLeft: () => turn(KEY_TURN, 0), ArrowRight: () => turn(-KEY_TURN, 0),
      ArrowUp: () => turn(0, KEY_TURN), ArrowDown: () => turn(0, -KEY_TURN),
      w: () => this.camera.move(0, 0, -KEY_MOVE), s: () => this.camera.move(0, 0, KEY_MOVE),
      a: () => this.camera.move(-KEY_MOVE, 0, 0), d: () => this.camera.move(KEY_MOVE, 0, 0),
      q: () => this.camera.move(0, -KEY_MOVE, 0), e: () => this.camera.move(0, KEY_MOVE, 0),
      "+": () => this.camera.zoom(0.95), "=": () => this.camera.zoom(0.95), "-": () => this.camera.zoom(1 / 0.95),
    };
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
    this.moved();
  }

  close() {
    this.closed = true;
    cancelAnimationFrame(this.request);
    this.stop.abort();
    this.observer.disconnect();
    this.renderer.close();
  }
}

(async () => {
  const live = element("scene").dataset.kind === "live", frames = element("frames").href;
  element("frames").hidden = !live;
  try {
    if (!live) {
      window.jaxnerf = new Page(await decodeScene(await loadBytes()));
      return;
    }
    if (location.search !== "?here" && !hasDevice()) throw new Error("This browser has no graphics device.");
    let scene = null;
    while (!(scene = await newerScene(""))) await wait(POLL_MS);
    window.jaxnerf = new Page(scene);
    window.jaxnerf.follow();
  } catch (error) {
    say(error.message);
    if (live) location.replace(frames);
  }
})();
