"use strict";
// The pattern at its real size. Lengths are in millimetres and in the display's own pixels, so that
// zooming the page changes nothing: a CSS pixel is devicePixelRatio of them.
const CARD = [85.6, 53.98]; // ISO/IEC 7810 ID-1
const at = (id) => document.getElementById(id);
const body = document.body;

function remembered(key) {
  try { return parseFloat(localStorage.getItem("invrender." + key)) || null; } catch { return null; }
}
function remember(key, value) {
  try { localStorage.setItem("invrender." + key, value); } catch { /* not from this file */ }
}

const given = parseFloat(body.dataset.ppi) || null;
const state = {
  ppi: given || remembered("ppi") || 96 * devicePixelRatio,
  side: parseFloat(body.dataset.mm), // its width
  deep: parseFloat(body.dataset.deep), // its height
  known: Boolean(given || remembered("ppi")),
  awake: null, // the wake lock
  told: "", // what was said to disturb
};

const pixels = (mm) => mm / 25.4 * state.ppi; // of the display
const css = (mm) => Math.round(pixels(mm)) / devicePixelRatio + "px";
// Full screen, if the browser can: then all of the display. Width and height in CSS pixels.
const display = () => {
  const full = document.fullscreenEnabled && !document.fullscreenElement;
  return full ? [Math.max(screen.width, innerWidth), Math.max(screen.height, innerHeight)]
    : [innerWidth, innerHeight];
};
const room = () => display().map((v) => v * devicePixelRatio / state.ppi * 25.4); // mm

// What would make the pattern another one than it is taken for.
function disturbed() {
  if (window.visualViewport && Math.abs(visualViewport.scale - 1) > 0.005) {
    return "The page is zoomed by two fingers: zoom out until it fits.";
  }
  if (matchMedia("(inverted-colors: inverted)").matches || matchMedia("(forced-colors: active)").matches) {
    return "The display changes colours for accessibility: switch that off while you take the picture.";
  }
  return "";
}

// Whether the page is smaller than the display: in a window, or zoomed where that changes no pixels.
function partial() {
  const wide = [screen.width, screen.height]; // some browsers do not turn these with the device
  return innerWidth < 0.98 * Math.max(...wide) && wide.every((w) => Math.abs(innerWidth - w) > 0.02 * w);
}

function layout() {
  at("card").style.width = css(CARD[0]);
  at("card").style.height = css(CARD[1]);
  for (const id of ["scale", "ppi"]) {
    if (document.activeElement !== at(id)) at(id).value = state.ppi.toFixed(1);
  }
  for (const id of ["side", "deep"]) {
    if (document.activeElement !== at(id)) at(id).value = state[id];
  }
  const metres = [state.side, state.deep].map((v) => (v / 1000).toFixed(4));
  at("metres").textContent = state.side === state.deep ? metres[0] : `[${metres.join(", ")}]`;
  const image = at("pattern");
  image.style.width = css(state.side);
  image.style.height = css(state.deep);
  // Beside the camera, at the left; in the middle of that edge.
  const free = innerHeight - Math.round(pixels(state.deep)) / devicePixelRatio;
  image.style.top = Math.round(Math.max(free, 0) / 2 * devicePixelRatio) / devicePixelRatio + "px";
  const [wide, high] = room();
  const fits = state.side > 0 && pixels(state.side) <= pixels(wide) + 1 &&
    state.deep > 0 && pixels(state.deep) <= pixels(high) + 1;
  at("fits").textContent = fits ? "" : "too large: this display, as it is held, shows at most " +
    `${Math.floor(wide * 2) / 2} × ${Math.floor(high * 2) / 2} mm`;
  const trouble = disturbed();
  at("zoomed").textContent = trouble;
  at("zoomed").hidden = !trouble;
  at("fits").className = fits ? "" : "bad";
  at("show").disabled = !fits;
  at("show").textContent = state.known ? "Show the pattern" : "Real size is right: show the pattern";
  if (!fits && body.classList.contains("shown") && !document.fullscreenElement) hide();
}

function setPpi(value) {
  if (!(value >= 30 && value <= 2000)) return;
  state.ppi = value;
  state.known = true;
  remember("ppi", value);
  layout();
}

function tell(text) {
  at("trouble").textContent = text;
  at("trouble").hidden = !text;
}

async function stayAwake() {
  try {
    state.awake = await navigator.wakeLock.request("screen");
    tell("");
  } catch {
    tell("This browser does not let a page keep the display on: set the device never to dim or " +
      "lock while you take the picture.");
  }
}

async function show() {
  setPpi(state.ppi);
  if (at("show").disabled) return;
  stayAwake();
  if (document.documentElement.requestFullscreen) {
    try { await document.documentElement.requestFullscreen({ navigationUI: "hide" }); } catch { /* as it is */ }
  }
  if (partial()) await new Promise((done) => setTimeout(done, 300)); // until full screen is drawn
  const trouble = disturbed() || (partial() ? "The page does not fill the display: set the browser's " +
    "zoom to 100% and use full screen." : "");
  if (trouble && state.told !== trouble) {
    state.told = trouble;
    hide();
    tell(trouble + " To show the pattern as it is, press again.");
    return;
  }
  body.classList.add("shown");
  scrollTo(0, 0);
  wind();
  layout();
}

function hide() {
  body.classList.remove("shown");
  clearInterval(timer);
  step = 0;
  at("pattern").src = shown[0];
  if (document.fullscreenElement) document.exitFullscreen();
  if (state.awake) state.awake.release();
  state.awake = null;
  layout();
}

at("scale").addEventListener("input", (e) => setPpi(parseFloat(e.target.value)));
at("ppi").addEventListener("input", (e) => setPpi(parseFloat(e.target.value)));
at("less").addEventListener("click", () => setPpi(state.ppi - 0.2));
at("more").addEventListener("click", () => setPpi(state.ppi + 0.2));
for (const id of ["side", "deep"]) {
  at(id).addEventListener("input", (e) => {
    const value = parseFloat(e.target.value);
    if (value >= 1 && value <= 5000) { state[id] = value; layout(); }
  });
}
at("fill").addEventListener("click", () => {
  [state.side, state.deep] = room().map((v) => Math.floor(v * 10) / 10);
  layout();
});
at("tablet").addEventListener("change", (e) => { if (e.target.value) setPpi(parseFloat(e.target.value)); });
for (const id of ["ppi", "side", "deep", "scale"]) at(id).addEventListener("change", layout);
at("show").addEventListener("click", show);
// Of a set, a tap shows the next pattern, or a timer, which a tap starts anew; after the last, the
// page.
let timer = 0;
function wind() {
  clearInterval(timer);
  const seconds = at("every") ? parseFloat(at("every").value) : 0;
  if (seconds > 0) timer = setInterval(next, 1000 * seconds);
}
const shown = [at("pattern"), ...document.querySelectorAll("img.next")].map((image) => image.src);
let step = 0;
function next() {
  step = (step + 1) % shown.length;
  if (step) at("pattern").src = shown[step]; else hide();
}
at("pattern").addEventListener("click", () => { wind(); next(); });
body.addEventListener("click", (e) => { if (e.target === body) hide(); });
document.addEventListener("contextmenu", (e) => e.preventDefault());
document.addEventListener("keydown", (e) => { if (e.key === "Escape") hide(); });
document.addEventListener("fullscreenchange", () => {
  if (!document.fullscreenElement && body.classList.contains("shown")) hide();
});
document.addEventListener("visibilitychange", () => {
  if (document.visibilityState === "visible" && body.classList.contains("shown")) stayAwake();
});
addEventListener("resize", layout);
if (window.visualViewport) visualViewport.addEventListener("resize", () => {
  if (body.classList.contains("shown") && Math.abs(visualViewport.scale - 1) > 0.005) hide();
  layout();
});
layout();
