// The page: the step that the address names, kept as the server tells it.
import { h, toast, go, onChange } from "./ui.js";
import { state, captureOf, takeIn } from "./state.js";
import { home } from "./home.js";
import { rig } from "./rig.js";
import { tablet } from "./tablet_step.js";
import { photo } from "./photo.js";
import { check } from "./check.js";
import { maps } from "./maps.js";
import { take } from "./take.js";

const STEPS = ["Rig", "Tablet", "Photo", "Maps", "Take away"];
let view = null, shown = null;

function drawSteps() {
  const { step: now, id } = shown;
  const to = ["#/rig", "#/tablet", id ? `#/c/${id}` : "#/photo", id && `#/c/${id}/maps`, id && `#/c/${id}/files`];
  const done = id && captureOf(id)?.report;
  document.getElementById("steps").replaceChildren(now < 0 ? "" : h("ol", {}, STEPS.map((name, i) => {
    const open = i < 3 || (i === 3 && id) || (i === 4 && done);
    const inside = [h("i", {}, String(i + 1)), h("b", {}, name)];
    const item = open ? h("a", { href: to[i], "aria-current": i === now && "step" }, inside)
      : h("span.off", { "aria-hidden": "true" }, inside);
    return h(i === now ? "li.now" : "li", {}, item);
  })));
}

const steps = onChange(() => [shown, !!(shown.id && captureOf(shown.id)?.report)], drawSteps);

const ROUTES = [
  [/^$/, home, -1, "Captures"], [/^rig$/, rig, 0, "Rig"], [/^tablet$/, tablet, 1, "Tablet"],
  [/^photo$/, photo, 2, "Photo"], [/^c\/([\w-]+)$/, check, 2, "Photo"],
  [/^c\/([\w-]+)\/maps$/, maps, 3, "Maps"], [/^c\/([\w-]+)\/files$/, take, 4, "Take away"],
];

function route() {
  const at = location.hash.replace(/^#\/?/, "");
  if (at === "main") return;
  for (const [pattern, make, step, title] of ROUTES) {
    const match = at.match(pattern);
    if (!match) continue;
    if (match[1] && !captureOf(match[1])) break;
    view?.end?.();
    const main = document.getElementById("main");
    main.replaceChildren();
    shown = { step, id: match[1] };
    steps();
    document.title = `${title} · invrender`;
    view = make(main, match[1]) || {};
    scrollTo(0, 0);
    main.focus({ preventScroll: true });
    return;
  }
  go("#/");
}

function update(id) {
  if (!shown) return;
  steps();
  if (!id || !shown.id || id === shown.id) view?.update?.(id);
}

function listen() {
  const events = new EventSource("/api/events");
  const offline = document.getElementById("offline");
  const on = (kind, act) => events.addEventListener(kind, (e) => act(JSON.parse(e.data)));
  on("state", (all) => {
    const first = !shown;
    Object.assign(state, all);
    offline.hidden = true;
    document.documentElement.dataset.connected = "yes";
    if (first) route(); else if (shown.id && !captureOf(shown.id)) go("#/"); else update();
  });
  on("capture", (capture) => { takeIn(capture); update(capture.id); });
  on("gone", (id) => {
    state.captures = state.captures.filter((c) => c.id !== id);
    if (shown?.id === id) go("#/"); else update();
  });
  on("profiles", (profiles) => { state.profiles = profiles; update(); });
  on("shown", (what) => { state.shown = what; update(); });
  events.onerror = () => {
    document.documentElement.dataset.connected = "no";
    offline.hidden = false;
    if (events.readyState === EventSource.CLOSED) {
      setTimeout(async () => {
        const answer = await fetch("/api/state").catch(() => null);
        if (answer?.status === 401) { location.reload(); return; }
        listen();
      }, 1000);
    }
  };
}

addEventListener("hashchange", route);
addEventListener("error", (e) => toast(`A fault of this page: ${e.message}`));
listen();
