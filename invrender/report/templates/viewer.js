"use strict";
// The live viewer: traces one object in a fragment shader, lit by a lamp and the captured room.
// data: as `invrender.report.page.viewer_data` makes it. The page has the canvas, the buttons and
// the sliders by these ids.
function startViewer(data) {
  const SHAPES = ["plane", "sphere", "cylinder", "cloth"];
  const SHOWN = ["material", "diffuse", "specular", "roughness", "normal"];
  const REACH = 1.15, EYE = [0, 0, 4];
  const LAMP_DISTANCE = 3, LAMP_REACH = 1.05;  // half the canvas, in sines of the lamp's angle
  const LEVELS = 4;  // of the blurred room beyond the sharp one, as in shade.glsl
  const BLURRED = 128, IRRADIANCE = 32, REFLECTANCE = 64;  // pixels a side
  const TABLE = 0.3;  // albedo of what lies below the horizon of a sphere or cylinder
  const FRAME = 18;  // ms to draw a frame while something moves: 30 a second with the browser's own work
  const EIGHTHS = 8, LEAST = 2;  // of the canvas's pixels a side, in which a slow viewer saves

  const canvas = document.getElementById("canvas"), handle = document.getElementById("handle");
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
  const state = {
    shape: "plane", show: "material", lamp: [-0.45, 0.5], power: 1, room: data.room ? 0.6 : 0,
    angle: 0, exposure: 0, turn: [0, 0],
  };
  const programs = new Map();
  let inputs, roomTexture, tableOf, stopped = false, queued = false, resting, slow = false;
  let share = 1;  // of the pixels a side, while something moves

  function fail(message) {
    const note = document.getElementById("viewer-note");
    note.textContent = message;
    note.hidden = false;
  }

  // A program of one of the shaders with its defines; made once.
  function program(name, defines) {
    const head = Object.entries(defines).map(([k, v]) => `#define ${k} ${Number(v)}\n`).join("");
    const key = name + head;
    if (programs.has(key)) return programs.get(key);
    const sources = [
      [gl.VERTEX_SHADER, "void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, " +
        "gl_VertexID == 2 ? 3 : -1, 0, 1); }"],
      [gl.FRAGMENT_SHADER, head + "precision highp float;\nprecision highp int;\n" +
        "precision highp sampler2D;\n" +
        data.shaders.brdf + data.shaders[name]],
    ];
    const made = gl.createProgram();
    for (const [kind, source] of sources) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, "#version 300 es\n" + source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS))
        throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    programs.set(key, made);
    return made;
  }

  // Set uniforms by their JavaScript values.
  function use(made, values) {
    gl.useProgram(made);
    let unit = 0;
    for (const [name, value] of Object.entries(values)) {
      const at = gl.getUniformLocation(made, name);
      if (at === null) continue;
      if (value.texture) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, value.texture);
        gl.uniform1i(at, unit++);
      } else if (typeof value === "number") gl.uniform1f(at, value);
      else if (value.length === 9) gl.uniformMatrix3fv(at, false, value);
      else gl.uniform3fv(at, value);
    }
    gl.activeTexture(gl.TEXTURE0);
  }

  function texture(width, height, { format = gl.RGBA16F, levels = 1, wrap = gl.CLAMP_TO_EDGE,
                                    min = gl.LINEAR } = {}) {
    const made = gl.createTexture(), kind = gl.TEXTURE_2D;
    gl.bindTexture(kind, made);
    gl.texStorage2D(kind, levels, format, width, height);
    gl.texParameteri(kind, gl.TEXTURE_WRAP_S, wrap);
    gl.texParameteri(kind, gl.TEXTURE_WRAP_T, wrap === gl.REPEAT ? gl.CLAMP_TO_EDGE : wrap);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, min === gl.NEAREST ? min : gl.LINEAR);
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, min);
    return { texture: made, width };
  }

  const allLevels = (size) => 1 + Math.floor(Math.log2(size));

  // Run a pass of filter.glsl into a square of a texture, all of its width, from a row on.
  function compute(pass, target, values = {}, row = 0) {
    const frame = gl.createFramebuffer(), size = target.width;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.texture, 0);
    gl.viewport(0, row, size, size);
    use(program("filter", { PASS: pass }), { size, row, ...values });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(frame);
  }

  // A texture of one of the PNG images, its bytes as they are.
  async function bytes(name, options) {
    const image = new Image();
    image.src = data.textures[name];
    await image.decode();
    const made = texture(data.size, data.size, options);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, image);
    if (options.levels) gl.generateMipmap(gl.TEXTURE_2D);
    return made;
  }

  async function load() {
    const mapped = { levels: allLevels(data.size), wrap: gl.MIRRORED_REPEAT,
                     min: gl.LINEAR_MIPMAP_NEAREST };
    const raw = { format: gl.RGBA8, min: gl.NEAREST };
    const albedo = { ...mapped, format: gl.SRGB8_ALPHA8 };
    inputs = {
      diffuse_map: await bytes("diffuse", albedo), specular_map: await bytes("specular", albedo),
      slopes_roughness: texture(data.size, data.size, mapped),
      reflectance_map: texture(REFLECTANCE, REFLECTANCE),
      irradiance_map: texture(IRRADIANCE, IRRADIANCE),
      blurred: texture(BLURRED, BLURRED * (LEVELS + 1)),
    };
    compute(0, inputs.slopes_roughness,
            { high_bytes: await bytes("high", raw), low_bytes: await bytes("low", raw) });
    gl.bindTexture(gl.TEXTURE_2D, inputs.slopes_roughness.texture);
    gl.generateMipmap(gl.TEXTURE_2D);
    compute(3, inputs.reflectance_map);
    if (data.room) loadRoom();
  }

  function loadRoom() {
    const { width, height, half } = data.room;
    const floats = new Uint16Array(Uint8Array.from(atob(half), (c) => c.charCodeAt(0)).buffer);
    roomTexture = texture(width, height, { levels: allLevels(width), wrap: gl.REPEAT,
                                           min: gl.LINEAR_MIPMAP_LINEAR });
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.HALF_FLOAT, floats);
    gl.generateMipmap(gl.TEXTURE_2D);
  }

  // Light the object by another room, of the form of `data.room`.
  function setRoom(room) {
    if (!gl || !inputs || !room) return;
    if (roomTexture) gl.deleteTexture(roomTexture.texture);
    data.room = room;
    tableOf = undefined;
    loadRoom();
    for (const name of ["room", "angle"]) document.getElementById(name).disabled = false;
    redraw();
  }

  // The room's filtered copies; a plane sees nothing below its horizon.
  function filterRoom() {
    const table = state.shape === "plane" ? 0 : TABLE;
    if (tableOf === table) return;
    tableOf = table;
    const values = { room: roomTexture, table: data.room.mean.map((c) => c * table) };
    compute(1, inputs.irradiance_map, values);
    for (let level = 0; level <= LEVELS; level++)
      compute(2, inputs.blurred, { ...values, roughness: level / LEVELS }, level * BLURRED);
  }

  function lampPlace() {
    const [x, y] = state.lamp;
    return [x, y, Math.sqrt(Math.max(1 - x * x - y * y, 0))].map((c) => c * LAMP_DISTANCE);
  }

  function turnMatrix() {  // columns: first about y, then about x
    const [yaw, pitch] = state.turn;
    const [c, s, k, z] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    return [c, z * s, -k * s, 0, k, z, s, -z * c, k * c];
  }

  // Draw; `view` overrides uniforms: eye, reach, and lamp and power in absolute terms.
  function draw(view = {}) {
    const material = state.show === "material";
    const lamp = material && state.power > 0, room = material && state.room > 0 && !!data.room;
    if (room) filterRoom();
    gl.viewport(0, 0, canvas.width, canvas.height);
    const a = state.angle * Math.PI / 180, [c, s] = [Math.cos(a), Math.sin(a)];
    use(program("shade", { SHAPE: SHAPES.indexOf(state.shape), SHOW: SHOWN.indexOf(state.show),
                           LAMP: lamp, ROOM: room }), {
      ...inputs, size: canvas.width, eye: EYE, reach: REACH, turn: turnMatrix(),
      lamp: lampPlace(), power: state.power * Math.PI * LAMP_DISTANCE ** 2, room: state.room,
      room_turn: [c, -s, 0, s, c, 0, 0, 0, 1], exposure: 2 ** state.exposure, ...view,
    });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    handle.style.left = 50 + state.lamp[0] * 50 / LAMP_REACH + "%";
    handle.style.top = 50 - state.lamp[1] * 50 / LAMP_REACH + "%";
    handle.hidden = !lamp;
  }

  // Set the canvas to a share of the pixels that the screen has for it.
  function resize(share) {
    const side = canvas.clientWidth * (devicePixelRatio || 1) * share;
    const size = Math.min(Math.max(Math.round(side), 64), 2048);
    if (canvas.width !== size) canvas.width = canvas.height = size;
  }

  // More pixels or fewer for the next frame, by what one took; a step at a time, since one frame
  // may have waited for something else.
  function adapt(took, most = 1) {
    const now = share * EIGHTHS, wanted = Math.round(now * Math.sqrt(FRAME / Math.max(took, 1)));
    const next = Math.min(Math.max(wanted, now - most), now + most);
    share = Math.min(Math.max(next, LEAST), EIGHTHS) / EIGHTHS;
  }

  // Draw soon; at rest with twice as many pixels a side, for smooth edges.
  function redraw() {
    clearTimeout(resting);
    if (stopped) return;
    if (!queued) {
      queued = true;
      requestAnimationFrame(() => {
        queued = false;
        resize(share);
        if (slow) adapt(frameTime(1)); else draw();
      });
    }
    resting = setTimeout(() => { resize(slow ? 1 : 2); draw(); }, 250);
  }

  // RGBA bytes of the canvas, first row at the bottom.
  function pixels(view) {
    draw(view);
    const out = new Uint8Array(4 * canvas.width * canvas.height);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, out);
    return out;
  }

  // Milliseconds a frame takes to be ready, the median of n.
  function frameTime(n = 9) {
    const one = new Uint8Array(4), times = [];
    for (let i = 0; i < n; i++) {
      const began = performance.now();
      draw();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, one);
      times.push(performance.now() - began);
    }
    return times.sort((a, b) => a - b)[n >> 1];
  }

  function place(event) {
    const box = canvas.getBoundingClientRect(), limit = 0.98;
    const x = ((event.clientX - box.left) / box.width * 2 - 1) * LAMP_REACH;
    const y = (1 - (event.clientY - box.top) / box.height * 2) * LAMP_REACH;
    const r = Math.hypot(x, y), k = r > limit ? limit / r : 1;
    return [x * k, y * k];
  }

  function connect() {
    let drag = null;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const turning = event.button === 2 || event.shiftKey || !event.isPrimary;  // or a second finger
      drag = { turning, finger: event.pointerId, x: event.clientX, y: event.clientY, turn: [...state.turn] };
      if (!turning) state.lamp = place(event);
      redraw();
    });
    canvas.addEventListener("pointermove", (event) => {
      if (drag?.finger !== event.pointerId) return;
      if (drag.turning) {
        const limit = state.shape === "plane" ? 1.3 : Math.PI;
        const clamp = (a, b) => Math.min(Math.max(a, -b), b), k = 4 / canvas.clientWidth;
        state.turn = [clamp(drag.turn[0] + (event.clientX - drag.x) * k, limit),
                      clamp(drag.turn[1] + (event.clientY - drag.y) * k, 1.3)];
      } else state.lamp = place(event);
      redraw();
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, () => { drag = null; });
    for (const name of ["shape", "show"]) {
      const buttons = [...document.querySelectorAll(`[data-${name}]`)];
      for (const button of buttons)
        button.addEventListener("click", () => {
          state[name] = button.dataset[name];
          if (name === "shape") state.turn = [0, 0];
          for (const b of buttons) b.setAttribute("aria-pressed", b === button);
          redraw();
        });
    }
    for (const name of ["power", "room", "angle", "exposure"]) {
      const input = document.getElementById(name);
      input.value = state[name];
      input.disabled = !data.room && (name === "room" || name === "angle");
      const show = () => {
        state[name] = Number(input.value);
        input.nextElementSibling.textContent = input.value + (input.dataset.unit || "");
      };
      show();
      input.addEventListener("input", () => { show(); redraw(); });
    }
    // By keyboard: arrows move the lamp, with shift they turn the object.
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
      const by = step[event.key];
      if (!by) return;
      event.preventDefault();
      if (event.shiftKey) {
        const limit = state.shape === "plane" ? 1.3 : Math.PI;
        state.turn = [Math.min(Math.max(state.turn[0] + by[0] * 0.1, -limit), limit),
                      Math.min(Math.max(state.turn[1] - by[1] * 0.1, -1.3), 1.3)];
      } else {
        const [x, y] = [state.lamp[0] + by[0] * 0.06, state.lamp[1] + by[1] * 0.06];
        const k = Math.min(0.98 / Math.hypot(x, y), 1);
        state.lamp = [x * k, y * k];
      }
      redraw();
    });
    new ResizeObserver(redraw).observe(canvas);
  }

  // Give the graphics memory back.
  function stop() {
    stopped = true;
    clearTimeout(resting);
    const extension = gl && gl.getExtension("WEBGL_lose_context");
    if (extension) extension.loseContext();
  }

  async function start() {
    if (!gl) return fail("The live viewer needs WebGL 2, which this browser does not offer.");
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float"))
      return fail("The live viewer needs float render targets, which this graphics driver lacks.");
    await load();
    if (stopped) return;
    resize(1);
    draw();
    const took = frameTime(3);
    slow = took > FRAME;  // no graphics processor: fewer pixels while something moves
    if (slow) adapt(took, EIGHTHS);
    connect();
    redraw();
    document.documentElement.dataset.viewer = "ready";
  }

  start().catch((error) => { if (!stopped) fail("The live viewer failed: " + error.message); });
  return { state, canvas, draw, pixels, frameTime, setRoom, redraw, stop };
}

if (document.getElementById("data"))
  window.viewer = startViewer(JSON.parse(document.getElementById("data").textContent));
