// Step 3, second half: what is found in the photo, and handles to put it right.
import { h, svg, api, attempt, go, onChange, sentence, percent } from "./ui.js";
import { state, captureOf, discard } from "./state.js";

const LINES = [["ball", "ball", "#7be08b"], ["horizon", "horizon in it", "#f2d75c"], ["screen", "screen in it", "#ff7a6b"], ["sample", "sample", "#62c2ff"], ["marker", "sheet's markers", "#ff7df0"]];
const CORNERS = ["lower left", "lower right", "upper right", "upper left"];
const DELAY = 700; // ms after the last movement
const COARSE = matchMedia("(pointer: coarse)"), FINGER = 11; // CSS pixels, a handle's radius under one

export function check(main, id) {
  const off = new Set(), one = captureOf(id);
  let number = one.photos.at(-1)?.number || 1, held = false, timer = null, fix = null;
  const stage = h("div.stage-photo"), side = h("div.stack"), tabs = h("div"), title = h("h1", {}, one.name);
  const legend = h("div.legend", {}, [...LINES, ["clipped", "saturated", "#ff3c3c"]].map(([key, label, colour]) => {
    const mark = h("i"); mark.style.borderColor = colour;
    return h("label", { "data-line": key }, h("input", { type: "checkbox", checked: true, onchange: (e) => { if (e.target.checked) off.delete(key); else off.add(key); draw(); } }), mark, label);
  }));
  main.append(title, tabs, h("div.split", {}, h("div", {}, stage, legend), h("aside.sheet.stack", {}, side)));
  const size = h("select", { id: "size" }, state.sizes.map((s) => h("option", { value: String(s) }, `${s} × ${s} pixels`)));
  size.value = "256";
  const make = h("button.primary", { type: "button", id: "make", onclick: () => attempt(async () => {
    await api(`/api/captures/${id}/refine`, "POST", { size: Number(size.value) });
    go(`#/c/${id}/maps`);
  }, make) }, "Make maps");
  const again = h("button", { type: "button", onclick: () => send({}) }, "Undo what was set by hand");
  const turn = h("button", { type: "button", onclick: () => send({ turn: ((answer()?.turn || 0) + 1) % 4 }) }, "Turn by a quarter");
  const remove = h("button.plain", { type: "button", onclick: () => attempt(async () => { await discard(captureOf(id)); go("#/"); }) }, "Discard");

  const answer = () => captureOf(id)?.photos.find((p) => p.number === number)?.check;
  const send = (values) => { clearTimeout(timer); return attempt(() => api(`/api/captures/${id}`, "PATCH", { number, fix: values })); };
  const later = () => { clearTimeout(timer); timer = setTimeout(() => { const values = fix; fix = null; send(values); }, DELAY); };

  const photos = () => captureOf(id).photos.map((p) => p.number);
  const drawTabs = onChange(() => [photos(), number], () => tabs.replaceChildren(photos().length < 2 ? "" : h("div.tabs", {}, photos().map((n) =>
    h("button", { type: "button", "aria-pressed": String(n === number), onclick: () => { number = n; draw(); } }, `Photo ${n}`)))));
  const drawSide = onChange(() => [number, answer()], () => side.replaceChildren(...verdict(answer())));
  let overlay, shownAt = null;
  function draw() {
    if (held) return;
    const a = answer();
    drawTabs();
    if (!a || !a.size) { stage.replaceChildren(h("div.wait", {}, a?.problem ? "This file could not be shown." : "Looking at the photo …")); shownAt = null; }
    else {
      if (shownAt !== a.shown) {
        const at = `/captures/${id}/photos/${number}`;
        overlay = svg("svg", { viewBox: `0 0 ${a.size[0]} ${a.size[1]}` });
        const photo = h("img", { src: `${at}/photo.jpg?${a.shown}`, alt: "The photo with what was found in it", width: a.size[0], height: a.size[1] });
        stage.replaceChildren(photo, h("img.clipped", { src: `${at}/clipped.png?${a.shown}`, alt: "" }), overlay);
        shownAt = a.shown;
      }
      stage.querySelector(".clipped").hidden = off.has("clipped");
      for (const label of legend.children) label.hidden = { marker: !a.markers?.length, clipped: !a.clipped }[label.dataset.line] || false;
      lines(a);
    }
    drawSide();
  }

  function lines(a) {
    const focused = document.activeElement?.dataset?.handle;
    overlay.replaceChildren();
    if (!off.has("marker")) for (const quad of a.markers || []) overlay.append(svg("polygon", { class: "line marker", points: quad.map((p) => p.join(",")).join(" ") }));
    for (const [name] of LINES) {
      if (off.has(name) || name === "sample" || !a.outlines?.[name]) continue;
      overlay.append(svg("polygon", { class: `line ${name}`, points: a.outlines[name].map((p) => p.join(",")).join(" ") }));
    }
    const corners = (a.corners || []).map((c) => [...c]), [w, ht] = a.size;
    const r = Math.max(Math.max(w, ht) / 110, COARSE.matches ? FINGER * w / (stage.clientWidth || w) : 0);
    const ball = a.ball ? [...a.ball] : a.problem ? [w / 2, ht / 2, Math.min(w, ht) / 18] : null;
    const known = a.fix || {};
    const now = () => ({ ...known, turn: a.turn || 0, ...(moved.ball ? { ball } : {}), ...(moved.corners ? { corners } : {}) });
    const moved = { ball: !!known.ball, corners: !!known.corners };
    const square = svg("polygon", { class: "line sample" }), ring = svg("circle", { class: "line ball" });
    const handles = [];
    const place = () => {
      square.setAttribute("points", corners.map((p) => p.join(",")).join(" "));
      if (ball) for (const [k, v] of [["cx", ball[0]], ["cy", ball[1]], ["r", ball[2]]]) ring.setAttribute(k, v);
      for (const handle of handles) { const [x, y] = handle.at(); handle.element.setAttribute("cx", x); handle.element.setAttribute("cy", y); }
    };
    const add = (label, what, at, move, radius = r) => {
      const element = svg("circle", { class: "handle", r: radius, tabindex: "0", role: "button", "data-handle": label, "aria-label": `${label}: arrow keys move it, with shift by ten pixels` });
      const by = (dx, dy) => { move(dx, dy); moved[what] = true; fix = now(); place(); };
      element.addEventListener("pointerdown", (e) => {
        e.preventDefault(); element.setPointerCapture(e.pointerId); element.focus(); held = true; clearTimeout(timer);
        const box = overlay.getBoundingClientRect(); let x = e.clientX, y = e.clientY;
        const go_on = (m) => { by((m.clientX - x) / box.width * w, (m.clientY - y) / box.height * ht); x = m.clientX; y = m.clientY; };
        const end = () => { held = false; element.removeEventListener("pointermove", go_on); if (fix) later(); };
        element.addEventListener("pointermove", go_on);
        element.addEventListener("pointerup", end, { once: true });
        element.addEventListener("pointercancel", end, { once: true });
      });
      element.addEventListener("keydown", (e) => {
        const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
        if (!step) return;
        e.preventDefault();
        const k = e.shiftKey ? 10 : 1;
        by(step[0] * k, step[1] * k); later();
      });
      handles.push({ element, at });
    };
    if (!off.has("sample")) {
      overlay.append(square);
      corners.forEach((c, i) => add(`Corner ${CORNERS[i]}`, "corners", () => c, (dx, dy) => { c[0] += dx; c[1] += dy; }));
    }
    if (ball && !off.has("ball")) {
      if (!a.outlines?.ball || a.problem) overlay.append(ring);
      add("Ball's middle", "ball", () => [ball[0], ball[1]], (dx, dy) => { ball[0] += dx; ball[1] += dy; overlay.append(ring); }, Math.min(r, Math.max(ball[2] / 3, r / 2)));
      add("Ball's edge", "ball", () => [ball[0] + ball[2], ball[1]], (dx) => { ball[2] = Math.max(2, ball[2] + dx); overlay.append(ring); }, r * 0.8);
    }
    overlay.append(...handles.map((handle) => handle.element));
    place();
    if (focused) overlay.querySelector(`[data-handle="${focused}"]`)?.focus();
  }

  function verdict(a) {
    const kind = !a ? "" : a.problem ? "bad" : !a.found ? "" : a.found.warnings.length ? "doubt" : "good";
    const mark = { "": "…", bad: "!", doubt: "!", good: "✓" }[kind];
    const words = { "": ["Looking", "Ball, screen and sample are being found."], bad: ["This will not do yet", ""],
      doubt: ["Usable, with a doubt", "Take the photo again if you can put this right:"], good: ["A good photo", "Everything was found and nothing is doubtful."] }[kind];
    const top = h(`div.verdict${kind && "." + kind}`, { role: "status" }, h("span.mark", { "aria-hidden": "true" }, mark),
      h("div", {}, h("b", {}, words[0]), h("span.soft", {}, a?.problem ? sentence(a.problem) : words[1])));
    const list = a?.found?.warnings.length ? h("ul.warnings", {}, a.found.warnings.map((w) => h("li", {}, sentence(w.text)))) : null;
    const advice = a?.found?.advice?.length ? h("details", { open: a.found.warnings.length === 0 }, h("summary", {}, "To do better next time"), h("ul.warnings.calm", {}, a.found.advice.map((w) => h("li", {}, sentence(w.text))))) : null;
    const hint = a?.problem && a.size ? h("p.small.soft", {}, "The handles can be dragged: put the green ring onto the ball, the blue square onto the sample.") : null;
    const f = a?.found;
    const table = f && h("details", {}, h("summary", {}, "Numbers"), h("table", {}, [
      ["Photo", `${f.photo[0]} × ${f.photo[1]}, ${f.fov.toFixed(1)}° across`],
      ["Sure of the ball", percent(f.ball_confidence)], ["Light from the pattern", percent(f.pattern_share)],
      ["Pattern fits within", percent(f.fit.residual, 1)], ["Sky seen", percent(f.coverage)],
      ["Saturated", percent(a.clipped, 2)]].map(([k, v]) => h("tr", {}, h("td", {}, k), h("td", {}, v)))),
      f.notes.map((n) => h("p.small.soft", {}, sentence(n.text))));
    make.disabled = !f;
    const fixed = a?.fix && Object.keys(a.fix).length > 0;
    return [top, list, advice, hint, table, h("div.field", {}, h("label", { for: "size" }, "Size of the maps"), size),
      h("div.actions", {}, make), h("div.actions", {}, turn, fixed ? again : null, remove)].filter(Boolean);
  }
  draw();
  return { update: draw, end: () => clearTimeout(timer) };
}
