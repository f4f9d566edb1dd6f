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
  side: parseFloat(body.dataset.mm),
  known: Boolean(given || remembered("ppi")),
  awake: null, // the wake lock
};

const pixels = (mm) => mm / 25.4 * state.ppi; // of the display
const css = (mm) => Math.round(pixels(mm)) / devicePixelRatio + "px";
// Full screen, if the browser can: then all of the display.
const room = () => {
  const zoom = devicePixelRatio;
  const full = document.fullscreenEnabled && !document.fullscreenElement;
  const width = full ? Math.max(screen.width, innerWidth) : innerWidth;
  const height = full ? Math.max(screen.height, innerHeight) : innerHeight;
  return Math.min(width, height) * zoom / state.ppi * 25.4; // mm
};

function layout() {
  at("card").style.width = css(CARD[0]);
  at("card").style.height = css(CARD[1]);
  for (const id of ["scale", "ppi"]) {
    if (document.activeElement !== at(id)) at(id).value = state.ppi.toFixed(1);
  }
  if (document.activeElement !== at("side")) at("side").value = state.side;
  at("metres").textContent = (state.side / 1000).toFixed(4);
  const image = at("pattern");
  image.style.width = image.style.height = css(state.side);
  // Beside the camera, at the left; in the middle of that edge.
  const free = innerHeight - Math.round(pixels(state.side)) / devicePixelRatio;
  image.style.top = Math.round(Math.max(free, 0) / 2 * devicePixelRatio) / devicePixelRatio + "px";
  const largest = room(), fits = state.side > 0 && pixels(state.side) <= pixels(largest) + 1;
  at("fits").textContent = fits ? "" :
    `too large: this display shows at most ${Math.floor(largest * 2) / 2} mm`;
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
  body.classList.add("shown");
  scrollTo(0, 0);
  layout();
}

function hide() {
  body.classList.remove("shown");
  if (document.fullscreenElement) document.exitFullscreen();
  if (state.awake) state.awake.release();
  state.awake = null;
  layout();
}

at("scale").addEventListener("input", (e) => setPpi(parseFloat(e.target.value)));
at("ppi").addEventListener("input", (e) => setPpi(parseFloat(e.target.value)));
at("less").addEventListener("click", () => setPpi(state.ppi - 0.2));
at("more").addEventListener("click", () => setPpi(state.ppi + 0.2));
at("side").addEventListener("input", (e) => {
  const value = parseFloat(e.target.value);
  if (value >= 1 && value <= 5000) { state.side = value; layout(); }
});
for (const id of ["ppi", "side", "scale"]) at(id).addEventListener("change", layout);
at("show").addEventListener("click", show);
at("pattern").addEventListener("click", hide);
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
layout();
