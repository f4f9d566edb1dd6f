// The captures on this machine, or what this is about where there are none.
import { h, drawing, attempt, onChange, percent } from "./ui.js";
import { state, captureOf, discard, example } from "./state.js";

const WORDS = { new: "photo", queued: "waiting", working: "being made", done: "maps", failed: "failed" };

const SCENE = `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 440 300" fill="none">
<defs><linearGradient id="s" x1="0" x2="1"><stop offset="0" stop-color="#ff8a7a"/><stop offset=".3" stop-color="#f6d365"/><stop offset=".6" stop-color="#7fd6a0"/><stop offset="1" stop-color="#6fa8ff"/></linearGradient>
<radialGradient id="b" cx=".35" cy=".28" r=".8"><stop offset="0" stop-color="#fff"/><stop offset=".35" stop-color="#a9c9e8"/><stop offset="1" stop-color="#274b70"/></radialGradient>
<linearGradient id="l" x1="0" y1="0" x2="0" y2="1"><stop offset="0" stop-color="#8fb8e6" stop-opacity=".38"/><stop offset="1" stop-color="#8fb8e6" stop-opacity="0"/></linearGradient></defs>
<path d="M70 82h190l70 150H100z" fill="url(#l)"/>
<rect x="56" y="58" width="212" height="20" rx="7" fill="#3a3f47"/><rect x="64" y="74" width="196" height="5" rx="2" fill="url(#s)"/>
<rect x="292" y="52" width="34" height="26" rx="6" fill="#3a3f47"/><circle cx="309" cy="79" r="5" fill="#7aa7d6"/>
<path d="M309 86v118" stroke="#8a8f98" stroke-width="1.5" stroke-dasharray="3 6"/>
<path d="M30 232h380" stroke="#8a8f98" stroke-width="1.5"/>
<rect x="112" y="222" width="140" height="10" rx="2" fill="#b98a5e"/><path d="M112 224h140" stroke="#d8b48d" stroke-width="2"/>
<path d="M285 232a24 24 0 0 1 48 0z" fill="url(#b)"/>
<g fill="#7b8088" font-family="system-ui, sans-serif" font-size="13"><text x="64" y="44">tablet, its pattern facing down</text><text x="298" y="40">phone</text><text x="150" y="256">sample</text><text x="288" y="256">mirror ball</text></g></svg>`;

export function home(main) {
  const inside = h("div"), cards = new Map();
  main.append(inside);
  const ids = onChange(() => state.captures.map((c) => c.id), () => {
    for (const c of state.captures) if (!cards.has(c.id)) cards.set(c.id, card(c));
    inside.replaceChildren(state.captures.length ? list(state.captures.map((c) => cards.get(c.id).element)) : welcome());
  });
  const draw = () => {
    ids();
    for (const c of state.captures) cards.get(c.id).tick(c);
  };
  draw();
  return { update: draw };
}

function welcome() {
  const art = drawing(SCENE);
  art.setAttribute("role", "img");
  art.setAttribute("aria-label", "A tablet hangs face down above the sample, a phone beside it looks down on a mirror ball");
  return h("div.hero", {},
    h("div", {}, h("h1", {}, "One photo in, a relightable material out"),
      h("p.lead", {}, "Hold a tablet above a flat sample, stand a small mirror ball beside it, and take one picture. These five steps lead through it. Nothing leaves this machine."),
      h("div.actions", {}, h("a.button.primary", { href: "#/rig" }, "Start"),
        h("button", { type: "button", id: "try", onclick: (e) => attempt(example, e.target) }, "Try the example photo"))),
    art);
}

function list(cards) {
  return h("div", {},
    h("div.actions", {}, h("h1", {}, "Captures")),
    h("div.actions", {}, h("a.button.primary", { href: "#/rig" }, "New capture"),
      h("a.button", { href: "#/photo" }, "Add photos"),
      h("button.plain", { type: "button", onclick: (e) => attempt(example, e.target) }, "Try the example photo")),
    h("ul.cards", {}, cards),
    h("p.soft.small", {}, "They are folders in ", h("code", {}, state.folder), "."));
}

// A capture's card, and a function that brings it up to date in place.
function card({ id }) {
  const picture = h("div.picture"), name = h("b"), words = h("span.state"), tags = h("div");
  const link = h("a", {}, picture, h("div.body", {}, name, words, tags));
  const more = h("button.more", { type: "button", onclick: () => attempt(() => discard(captureOf(id))) }, "Discard");
  const draw = (c) => {
    const first = c.photos.find((p) => p.check?.shown);
    const source = c.report ? `/captures/${id}/preview_lit.jpg?${c.report.made}`
      : first ? `/captures/${id}/photos/${first.number}/photo.jpg?${first.check.shown}` : null;
    if (picture.dataset.source !== String(source)) {
      picture.dataset.source = source;
      picture.replaceChildren(source ? h("img", { src: source, alt: "", loading: "lazy" }) : h("div.blank"));
    }
    const problem = c.state === "new" && c.photos.some((p) => p.check?.problem);
    link.href = c.state === "new" ? `#/c/${id}` : `#/c/${id}/maps`;
    name.textContent = c.name;
    words.className = `state ${problem ? "failed" : c.state}`;
    words.textContent = problem ? "needs a look"
      : c.state === "working" && c.progress ? `${WORDS.working}, ${percent(c.progress.share)}` : WORDS[c.state];
    tags.replaceChildren(...c.tags.map((t) => h("span.tag", {}, t)));
    more.setAttribute("aria-label", `Discard ${c.name}`);
  };
  let last = null;
  const tick = (c) => { if (c !== last) draw(last = c); };
  return { element: h("li.card", {}, link, more), tick };
}
