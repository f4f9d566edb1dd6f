// Step 1: the tablet, the ball and where they stand; kept as profiles.
import { h, drawing, api, attempt, go, toast } from "./ui.js";
import { state, chosen, choose } from "./state.js";

const NUMBERS = ["side", "depth", "sample", "height", "gap", "ball", "ppi"];
const NEEDED = ["side", "height", "gap", "ball"], OPTIONAL = ["depth", "sample", "ppi"];
const INCH = 25.4; // mm
const depth = (p) => p.depth || p.side, sample = (p) => p.sample || Math.min(p.side, depth(p)) / 2;
// As `invrender.pattern.guide.needed_focal`: 35 mm equivalent by diagonals, 4:3 photo, 5% free.
const lens = (p) => Math.hypot(36, 24) / 2 * 0.8 / ((sample(p) + p.gap / 2) / p.height) * 0.95;

export function rig(main) {
  let profile = { ...chosen() }, dirty = false;
  const picture = h("div.drawing"), note = h("p.small.soft", { role: "status" });
  const at = {};
  const field = (key, label, hint, unit = "mm") => {
    at[key] = h("input", { id: `rig-${key}`, type: "number", step: "any", inputmode: "decimal", required: NEEDED.includes(key),
      oninput: () => { profile[key] = at[key].value === "" ? null : Number(at[key].value); dirty = true; redraw(); } });
    return h("div.field", {}, h("label", { for: `rig-${key}` }, label),
      h("div.unit", {}, at[key], h("span.soft", {}, unit)), h("span.soft", {}, hint));
  };
  const tablets = h("select", { id: "rig-tablet", onchange: () => {
    const t = state.tablets.find((x) => x.name === tablets.value);
    profile.tablet = tablets.value;
    if (t) {
      profile.ppi = t.ppi;
      // All of the display, to a tenth of a millimetre that it surely has.
      [profile.side, profile.depth] = [t.long, t.short].map((n) => Math.floor(n / t.ppi * INCH * 10) / 10);
      profile.sample = null;
      profile.height = Math.round(profile.depth * 0.85);
    }
    dirty = true; fill();
  } }, h("option", { value: "" }, "Another display: type its sizes"), state.tablets.map((t) => h("option", { value: t.name }, t.name)));
  const shape = h("select", { id: "rig-shape", onchange: () => { profile.shape = shape.value; dirty = true; redraw(); } },
    [["", "The photo shows it"], ["hemisphere", "Half a ball, flat side down"], ["sphere", "A whole ball"]].map(([v, t]) => h("option", { value: v }, t)));
  const photos = h("select", { id: "rig-photos", onchange: () => { profile.photos = Number(photos.value); dirty = true; } },
    h("option", { value: "1" }, "One"), h("option", { value: "5" }, "Five, one a pattern: better relief"));
  const name = h("input", { id: "rig-name", maxlength: 80, oninput: () => { profile.name = name.value; dirty = true; } });
  const which = h("select", { id: "rig-profile", onchange: () => {
    if (which.value === "new") profile = { ...profile, id: "", name: "My rig" };
    else { choose(which.value); profile = { ...chosen() }; }
    dirty = which.value === "new"; fill();
  } });

  const save = async () => {
    if (dirty || !profile.id) {
      const { id, ...values } = profile;
      const made = await api("/api/profiles", "POST", id && id !== "00000000" ? { id, ...values } : values);
      const known = state.profiles.findIndex((p) => p.id === made.id);
      if (known >= 0) state.profiles[known] = made; else state.profiles.unshift(made);
      choose(made.id); profile = { ...made }; dirty = false;
    } else choose(profile.id);
  };
  const next = h("button.primary", { type: "submit", id: "rig-next" }, "Continue");
  const form = h("form.stack", { novalidate: true, onsubmit: (e) => { e.preventDefault(); attempt(async () => { await save(); go("#/tablet"); }, next); } },
    h("div.sheet.stack", {},
      h("div.fields", {}, h("div.field", {}, h("label", { for: "rig-profile" }, "Rig"), which),
        h("div.field", {}, h("label", { for: "rig-name" }, "Its name"), name)),
      h("fieldset", {}, h("legend", {}, "Tablet"), h("div.stack", {},
        h("div.field", {}, h("label", { for: "rig-tablet" }, "Model"), tablets),
        h("div.fields", {}, field("side", "Lit area, towards the phone", "a tablet's long side, as large as the display allows"),
          field("depth", "Lit area, across", "left empty, it is a square"),
          field("ppi", "Pixels per inch", "left empty, the tablet's page asks for it", "ppi")))),
      h("fieldset", {}, h("legend", {}, "Where it hangs"), h("div.fields", {},
        field("height", "Display above the table", "0.85 of the shorter side is good"),
        field("gap", "Pattern's edge to the lens", "the lens beside the tablet, as high"),
        field("sample", "Side of the square sample", "left empty, half of the lit area's shorter side"))),
      h("fieldset", {}, h("legend", {}, "Mirror ball and photos"), h("div.fields", {},
        field("ball", "Diameter of the ball", "a tenth of the side serves"),
        h("div.field", {}, h("label", { for: "rig-shape" }, "Its shape"), shape),
        h("div.field", {}, h("label", { for: "rig-photos" }, "Photos of a sample"), photos)))),
    h("div.actions", {}, next,
      h("button", { type: "button", id: "rig-guide", onclick: (e) => attempt(async () => {
        await save();
        const link = h("a", { href: `/api/profiles/${profile.id}/guide.pdf`, download: "invrender-guide.pdf" });
        document.body.append(link); link.click(); link.remove();
      }, e.target) }, "Print the guide and sheet"),
      h("button.plain", { type: "button", onclick: (e) => attempt(async () => {
        if (!profile.id || state.profiles.length < 2) { toast("This is the only rig; there must be one."); return; }
        await api(`/api/profiles/${profile.id}`, "DELETE");
        state.profiles = state.profiles.filter((p) => p.id !== profile.id);
        profile = { ...chosen() }; dirty = false; fill();
      }, e.target) }, "Delete this rig")));
  main.append(h("h1", {}, "Rig"), h("p.lead", {}, "Which tablet, which ball, and where they stand. You do this once; it is kept."),
    h("div.split", {}, form, h("aside.sheet.drawing", { "aria-label": "The rig, drawn to scale" }, picture, note)));

  function fill() {
    which.replaceChildren(...state.profiles.map((p) => h("option", { value: p.id }, p.name)), h("option", { value: "new" }, "New rig …"));
    which.value = profile.id || "new";
    name.value = profile.name; tablets.value = profile.tablet || ""; shape.value = profile.shape || ""; photos.value = String(profile.photos || 1);
    for (const key of NUMBERS) at[key].value = profile[key] ?? "";
    redraw();
  }
  function redraw() {
    const p = profile, right = NEEDED.every((k) => p[k] > 0) && OPTIONAL.every((k) => p[k] === null || p[k] === undefined || p[k] > 0);
    next.disabled = !right;
    at.depth.placeholder = p.side > 0 ? p.side : "";
    at.sample.placeholder = p.side > 0 ? +(Math.min(p.side, depth(p)) / 2).toFixed(1) : "";
    if (!right) { note.textContent = "Every length must be a number above 0."; return; }
    picture.replaceChildren(plan(p));
    note.textContent = `The sample is ${sample(p).toFixed(0)} × ${sample(p).toFixed(0)} mm. The phone's lens: ${lens(p).toFixed(0)} mm or wider (35 mm equivalent).`;
  }
  fill();
  return {};
}

// The rig from the side and from above, to scale; lengths in millimetres.
function plan(p) {
  const w = p.side, l = depth(p), a = sample(p) / 2, { height: h, ball } = p, d = p.gap / 2, axis = a + d, r = ball / 2;
  const edge = a - d, left = edge - w, right = axis + Math.max(r, l * 0.12) + l * 0.06, width = right - left, k = Math.max(width / 215, l / 200);
  const deep = Math.max(l / 2, a, r), pad = 16 * k, top = 20 * k, y0 = top + h + 4 * k, y1 = y0 + 36 * k + deep, low = y1 + deep + 26 * k;
  const f = (x) => x.toFixed(1), mm = (x) => `${+x.toFixed(1)} mm`, size = 8.2 * k;
  const text = (x, y, t, anchor = "middle") => `<text x="${f(x)}" y="${f(y)}" text-anchor="${anchor}">${t}</text>`;
  const arrow = (x1, ya, x2, yb) => `<path class="dim" d="M${f(x1)} ${f(ya)}L${f(x2)} ${f(yb)}"/>`;
  const whole = p.shape === "sphere";
  return drawing(`<svg xmlns="http://www.w3.org/2000/svg" viewBox="${f(left - pad)} 0 ${f(width + 2 * pad)} ${f(low)}" role="img" aria-label="The rig from the side and from above">
<g fill="none" stroke-width="${f(1.1 * k)}"><path stroke="#8a8f98" d="M${f(Math.min(left, -a))} ${f(y0)}H${f(right)}"/>
<path stroke="#c89b70" stroke-width="${f(4 * k)}" d="M${f(-a)} ${f(y0)}H${f(a)}"/>
<path stroke="#4a86c5" stroke-width="${f(4 * k)}" d="M${f(left)} ${f(y0 - h)}H${f(edge)}"/>
<path stroke="#8a8f98" stroke-dasharray="${f(4 * k)} ${f(4 * k)}" d="M${f(axis)} ${f(y0 - h)}V${f(y0)}"/></g>
${[-a, a].map((x) => `<path fill="none" stroke="#8a8f98" stroke-opacity=".45" stroke-width="${f(0.6 * k)}" d="M${f(2 * x - axis)} ${f(y0 - h)}L${f(x)} ${f(y0)}L${f(axis)} ${f(y0 - h)}"/>`).join("")}
${whole ? `<circle cx="${f(axis)}" cy="${f(y0 - r)}" r="${f(r)}" fill="#c4694f"/>` : `<path fill="#c4694f" d="M${f(axis - r)} ${f(y0)}a${f(r)} ${f(r)} 0 0 1 ${f(2 * r)} 0z"/>`}
<circle cx="${f(axis)}" cy="${f(y0 - h)}" r="${f(3 * k)}" fill="#8a8f98"/>
<g fill="none" stroke="#8a8f98" stroke-width="${f(0.6 * k)}">${arrow(left + 5 * k, y0 - h + 5 * k, left + 5 * k, y0 - 3 * k)}</g>
<rect x="${f(left)}" y="${f(y1 - l / 2)}" width="${f(w)}" height="${f(l)}" fill="#4a86c5" fill-opacity=".1" stroke="#4a86c5" stroke-width="${f(k)}" stroke-dasharray="${f(4 * k)} ${f(3 * k)}"/>
<rect x="${f(-a)}" y="${f(y1 - a)}" width="${f(2 * a)}" height="${f(2 * a)}" fill="#c89b70" fill-opacity=".3" stroke="#c89b70" stroke-width="${f(1.2 * k)}"/>
<circle cx="${f(axis)}" cy="${f(y1)}" r="${f(r)}" fill="#c4694f"/>
<g fill="none" stroke="#8a8f98" stroke-width="${f(0.6 * k)}">${arrow(edge, y1 - l / 2 - 4 * k, axis, y1 - l / 2 - 4 * k)}</g>
<g class="words" font-size="${f(size)}" font-family="system-ui, sans-serif">${text((left + edge) / 2, y0 - h - 6 * k, `pattern, ${mm(w)}${l === w ? "" : ` × ${mm(l)}`}`)}${text(0, y0 + 12 * k, "sample")}${text(axis, y0 + 12 * k, "ball")}${text(axis + 3 * k, y0 - h - 6 * k, "lens")}${text(left + 8 * k, y0 - h / 2, mm(h), "start")}${text(0, y1 + 3 * k, mm(2 * a))}${text((edge + axis) / 2, y1 - l / 2 - 8 * k, mm(2 * d))}${text(left, low - 5 * k, "from above, as the photo shows it", "start")}</g></svg>`);
}
