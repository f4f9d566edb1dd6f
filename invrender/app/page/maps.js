// Step 4: the maps as they are made, then the material to look at.
import { h, api, attempt, go, sentence, percent } from "./ui.js";
import { captureOf, discard } from "./state.js";

const MAPS = [["diffuse", "Diffuse albedo"], ["specular", "Specular albedo"], ["roughness", "Roughness"], ["normal", "Normal"]];
const STAGES = { lights: "Reading the light from the ball", preview: "A first, quick look", crop: "Cutting out the sample", read: "Loading the networks", "forward model": "Preparing the renderer", "initial maps": "The networks' first maps", refine: "Refining against the photo", render: "Rendering", write: "Writing" };
const SLIDERS = [["power", "Lamp", 0, 3, 0.05, " ×"], ["room", "Room", 0, 3, 0.05, " ×"], ["angle", "Turn room", -180, 180, 1, "°"], ["exposure", "Exposure", -4, 4, 0.1, " EV"]];
const ZOOM = 4;

export function maps(main, id) {
  const inside = h("div");
  main.append(inside);
  let mode = null, made = null, end = null, tick = null;
  function draw() {
    const c = captureOf(id);
    if (!c) return;
    const now = c.state === "working" || c.state === "queued" ? "wait" : c.report ? "look" : "start";
    if (now === mode && (now !== "look" || made === c.report.made)) { tick?.(c); return; }
    end?.(); end = tick = null;
    mode = now; made = c.report?.made;
    inside.replaceChildren();
    [end, tick] = { wait: waiting, look: looking, start: starting }[now](inside, c);
  }
  draw();
  return { update: draw, end: () => end?.() };
}

function starting(root, c) {
  const again = h("button.primary", { type: "button", onclick: () => attempt(() => api(`/api/captures/${c.id}/refine`, "POST", { size: c.job?.size || 256 }), again) }, "Make maps");
  const note = h("div");
  root.append(h("h1", {}, c.name), note, h("div.actions", {}, again, h("a.button", { href: `#/c/${c.id}` }, "Back to the photo")));
  const tick = (c) => note.replaceChildren(c.problem
    ? h("div.verdict.bad", { role: "status" }, h("span.mark", { "aria-hidden": "true" }, "!"), h("div", {}, h("b", {}, "No maps were made"), h("span", {}, sentence(c.problem))))
    : h("p.lead", {}, "There are no maps of this capture yet."));
  tick(c);
  return [null, tick];
}

function waiting(root, c) {
  const meter = h("i"), words = h("p.lead", { role: "status" }), previews = h("div.previews");
  const bar = h("div.meter", { role: "progressbar", "aria-label": "Progress", "aria-valuemin": "0", "aria-valuemax": "100" }, meter);
  let seen = null, share = 0;
  root.append(h("h1", {}, c.name), words, bar,
    h("div.actions", {}, h("button", { type: "button", id: "cancel", onclick: (e) => attempt(() => api(`/api/captures/${c.id}/cancel`, "POST"), e.target) }, "Cancel"), h("a.button", { href: "#/" }, "Do something else meanwhile")), previews);
  previews.append(...MAPS.map(([name, title]) => h("figure", {}, h("div.blank", { "data-map": name }), h("figcaption", {}, title))));
  const tick = (c) => {
    const p = c.progress || {}, stage = (p.stage || "").split(":")[0];
    share = c.state === "queued" ? 0 : Math.max(share, p.share || 0);
    meter.style.width = percent(share);
    bar.setAttribute("aria-valuenow", Math.round(100 * share));
    const text = c.state === "queued" ? (c.queue > 1 ? `Waiting: ${c.queue - 1} before this one.` : "Waiting.") : `${STAGES[stage] || "Working"} …`;
    if (words.textContent !== text) words.textContent = text;
    if (p.preview && p.preview !== seen) {
      seen = p.preview;
      for (const [name, title] of MAPS) {
        const image = h("img", { src: `/captures/${c.id}/preview_${name}.jpg?${seen}`, alt: title, "data-map": name });
        image.decode().then(() => previews.querySelector(`[data-map="${name}"]`)?.replaceWith(image)).catch(() => {});
      }
    }
  };
  tick(c);
  return [null, tick];
}

function looking(root, c) {
  const panel = h("div", { role: "tabpanel", id: "panel", tabindex: "-1" });
  let end = null;
  const TABS = { Relight: relight, Maps: flat, "Photo and re-rendering": compare };
  const select = (name) => {
    end?.();
    panel.replaceChildren();
    panel.setAttribute("aria-label", name);
    for (const b of tabs.children) { b.setAttribute("aria-selected", String(b.textContent === name)); b.tabIndex = b.textContent === name ? 0 : -1; }
    end = TABS[name](panel, c);
  };
  const tabs = h("div.tabs", { role: "tablist", "aria-label": "Ways to look at it", onkeydown: (e) => {
    const all = [...tabs.children], i = all.indexOf(document.activeElement), by = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
    if (by) { const to = all[(i + by + all.length) % all.length]; to.focus(); select(to.textContent); }
  } }, Object.keys(TABS).map((name) => h("button", { type: "button", role: "tab", "aria-controls": "panel", onclick: () => select(name) }, name)));
  const r = c.report, seconds = Object.values(r.seconds).reduce((a, b) => a + b, 0);
  const notes = h("textarea", { id: "notes", placeholder: "What it is, where it is from …", onchange: () => save({ notes: notes.value }) });
  const tags = h("input", { id: "tags", placeholder: "wood, floor", onchange: () => save({ tags: tags.value.split(",") }) });
  const name = h("input", { id: "name", maxlength: 80, onchange: () => save({ name: name.value }) });
  notes.value = c.notes; tags.value = c.tags.join(", "); name.value = c.name;
  const title = h("h1", {}, c.name);
  const save = (values) => attempt(() => api(`/api/captures/${c.id}`, "PATCH", values));
  root.append(title, h("p.lead", {}, `${r.size} × ${r.size} pixels of ${(1000 * r.sample_size).toFixed(0)} × ${(1000 * r.sample_size).toFixed(0)} mm, made in ${seconds.toFixed(0)} s.`),
    tabs, panel,
    h("div.actions", {}, h("a.button.primary", { href: `#/c/${c.id}/files`, id: "take" }, "Take it away"), h("a.button", { href: `/captures/${c.id}/report.html`, target: "_blank", rel: "noopener" }, "Whole report")),
    r.warnings.length ? h("section", {}, h("h2", {}, "What is doubtful"), h("ul.warnings", {}, r.warnings.map((w) => h("li", {}, sentence(w.text))))) : "",
    h("section.sheet.stack", { "aria-label": "Notes" }, h("div.fields", {}, h("div.field", {}, h("label", { for: "name" }, "Name"), name), h("div.field", {}, h("label", { for: "tags" }, "Tags, with commas"), tags)),
      h("div.field", {}, h("label", { for: "notes" }, "Notes"), notes),
      h("div", {}, h("button.plain", { type: "button", onclick: () => attempt(async () => { await discard(c); go("#/"); }) }, "Discard this capture"))));
  select("Relight");
  return [() => end?.(), (c) => { title.textContent = c.name; }];
}

function relight(panel, c) {
  const buttons = (what, names, first) => h("fieldset", {}, h("legend", {}, what === "shape" ? "Shape" : "Show"), h("div.choice", {}, names.map((n) => h("button", { type: "button", [`data-${what}`]: n, "aria-pressed": String(n === first) }, n))));
  const rooms = h("select", { id: "rooms" }, h("option", { value: "" }, "as captured"));
  panel.append(h("div.viewer", {},
    h("div.stage", {}, h("canvas", { id: "canvas", tabindex: "0", role: "img", "aria-label": "The material, rendered live: arrow keys move the lamp, with shift they turn the object" }), h("div", { id: "handle", hidden: true }), h("p.soft", { id: "viewer-note", hidden: true })),
    h("div.stack", {}, buttons("shape", ["plane", "sphere", "cylinder", "cloth"], "plane"), buttons("show", ["material", ...MAPS.map((m) => m[0])], "material"),
      h("div.field", {}, h("label", { for: "rooms" }, "Room"), rooms),
      h("div", {}, SLIDERS.map(([key, label, low, high, step, unit]) => h("div.slider", {}, h("label", { for: key }, label), h("input", { type: "range", id: key, min: low, max: high, step, "data-unit": unit }), h("output", { for: key })))),
      h("p.small.soft", {}, "Drag to move the lamp; with shift, the right button or a second finger, to turn the object."))));
  let viewer = null, gone = false, captured = null, others = null;
  attempt(async () => {
    const data = await api(`/captures/${c.id}/viewer.json?${c.report.made}`);
    if (gone) return;
    captured = data.room;
    if (!captured) rooms.options[0].textContent = "dark, as captured";
    viewer = window.viewer = window.startViewer(data);
    others = await api("/api/rooms");
    for (const kind of Object.keys(others)) rooms.append(h("option", { value: kind }, `a ${kind}`));
  });
  rooms.addEventListener("change", () => viewer?.setRoom(rooms.value ? others[rooms.value] : captured));
  return () => { gone = true; viewer?.stop(); delete document.documentElement.dataset.viewer; };
}

function flat(panel, c) {
  const shade = h("input", { type: "range", id: "sure", min: 0, max: 1, step: 0.05, value: "0" });
  const all = MAPS.map(([name, title]) => {
    const source = `/captures/${c.id}/map_${name}.jpg?${c.report.made}`;
    const sigma = h("img.sigma", { src: `/captures/${c.id}/sigma_${name}.jpg?${c.report.made}`, alt: "" });
    const loupe = h("div.loupe", { hidden: true });
    loupe.style.backgroundImage = `url("${source}")`;
    const box = h("div.map", { tabindex: "0", role: "img", "aria-label": `${title}; a loupe follows the pointer` }, h("img", { src: source, alt: "" }), sigma, loupe);
    const at = (e) => {
      const b = box.getBoundingClientRect(), x = e.clientX - b.left, y = e.clientY - b.top, half = loupe.offsetWidth / 2 || 80;
      loupe.hidden = e.type === "pointerleave" || x < 0 || y < 0 || x > b.width || y > b.height;
      loupe.style.left = `${x}px`; loupe.style.top = `${y}px`;
      loupe.style.backgroundSize = `${b.width * ZOOM}px ${b.height * ZOOM}px`;
      loupe.style.backgroundPosition = `${half - x * ZOOM}px ${half - y * ZOOM}px`;
    };
    for (const kind of ["pointermove", "pointerdown", "pointerleave"]) box.addEventListener(kind, at);
    return { sigma, figure: h("figure", {}, box, h("figcaption", {}, title)) };
  });
  const set = () => { for (const m of all) m.sigma.style.opacity = shade.value; };
  shade.addEventListener("input", set);
  set();
  panel.append(h("div.maps2", {}, all.map((m) => m.figure)),
    h("div.slider.wide", {}, h("label", { for: "sure" }, "Expected error"), shade),
    h("p.small.soft", {}, "The slider lays the expected error over each map: dark is certain, bright yellow is ± 0.2 or more of a range of 1, a guess."));
  return null;
}

function compare(panel, c) {
  const over = h("img", { src: `/captures/${c.id}/render.png?${c.report.made}`, alt: "The re-rendering" });
  const slider = h("input", { type: "range", id: "split", min: 0, max: 100, value: "50", "aria-label": "From photo to re-rendering" });
  const set = () => { over.style.clipPath = `inset(0 0 0 ${slider.value}%)`; };
  slider.addEventListener("input", set);
  panel.append(h("div.compare", {}, h("img", { src: `/captures/${c.id}/photo.png?${c.report.made}`, alt: "The sample in the photo" }), over, h("span.l", {}, "photo"), h("span.r", {}, "re-rendering")), slider,
    h("p.small.soft", {}, `They differ by ${percent(c.report.photo_error.refined, 1)} of the photo's mean.`));
  set();
  return null;
}

