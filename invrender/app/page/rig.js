// Step 1: the tablet, the ball and where they stand; kept as profiles.
import { h, drawing, api, attempt, go, toast } from "./ui.js";
import { state, chosen, choose } from "./app.js";

const NUMBERS = ["side", "height", "gap", "ball", "ppi"];
// As `invrender.pattern.guide.needed_focal`: 35 mm equivalent by diagonals, 4:3 photo, 5% free.
const lens = (p) => Math.hypot(36, 24) / 2 * 0.8 / ((p.side / 4 + p.gap / 2 + p.side / 4) / p.height) * 0.95;

export function rig(main) {
  let profile = { ...chosen() }, dirty = false;
  const picture = h("div.drawing"), note = h("p.small.soft", { role: "status" });
  const at = {};
  const field = (key, label, hint, unit = "mm") => {
    at[key] = h("input", { id: `rig-${key}`, type: "number", step: "any", inputmode: "decimal", required: key !== "ppi",
      oninput: () => { profile[key] = at[key].value === "" ? null : Number(at[key].value); dirty = true; redraw(); } });
    return h("div.field", {}, h("label", { for: `rig-${key}` }, label),
      h("div.unit", {}, at[key], h("span.soft", {}, unit)), h("span.soft", {}, hint));
  };
  const tablets = h("select", { id: "rig-tablet", onchange: () => {
    const t = state.tablets.find((x) => x.name === tablets.value);
    profile.tablet = tablets.value;
    if (t) {
      profile.ppi = t.ppi;
      profile.side = Math.floor(t.short / t.ppi * 25.4 - 1);
      profile.height = Math.round(profile.side * 0.85);
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
        h("div.fields", {}, field("side", "Side of the square pattern", "as large as the display allows"),
          field("ppi", "Pixels per inch", "left empty, the tablet's page asks for it", "ppi")))),
      h("fieldset", {}, h("legend", {}, "Where it hangs"), h("div.fields", {},
        field("height", "Display above the table", "0.85 of the side is good"),
        field("gap", "Pattern's edge to the lens", "the lens beside the tablet, as high"))),
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
    const p = profile, right = ["side", "height", "gap", "ball"].every((k) => p[k] > 0);
    next.disabled = !right;
    if (!right) { note.textContent = "Every length must be a number above 0."; return; }
    picture.replaceChildren(plan(p));
    note.textContent = `The sample is ${(p.side / 2).toFixed(0)} × ${(p.side / 2).toFixed(0)} mm. The phone's lens: ${lens(p).toFixed(0)} mm or wider (35 mm equivalent).`;
  }
  fill();
  return {};
}

// The rig from the side and from above, to scale; lengths in millimetres.
function plan(p) {
  const { side: l, height: h, ball } = p, d = p.gap / 2, axis = l / 4 + d, r = ball / 2;
  const left = -0.75 * l - d, right = axis + Math.max(r, l * 0.12) + l * 0.06, width = right - left, k = l / 180;
  const pad = 16 * k, top = 20 * k, y0 = top + h + 4 * k, y1 = y0 + 52 * k + l / 2, low = y1 + l / 2 + 26 * k;
  const f = (x) => x.toFixed(1), mm = (x) => `${+x.toFixed(1)} mm`, size = 8.2 * k;
  const text = (x, y, t, anchor = "middle") => `<text x="${f(x)}" y="${f(y)}" text-anchor="${anchor}">${t}</text>`;
  const arrow = (x1, ya, x2, yb) => `<path class="dim" d="M${f(x1)} ${f(ya)}L${f(x2)} ${f(yb)}"/>`;
  const whole = p.shape === "sphere";
  const made = drawing(`<svg xmlns="http://www.w3.org/2000/svg" viewBox="${f(left - pad)} 0 ${f(width + 2 * pad)} ${f(low)}" role="img" aria-label="The rig from the side and from above">
<g fill="none" stroke-width="${f(1.1 * k)}"><path stroke="#8a8f98" d="M${f(left)} ${f(y0)}H${f(right)}"/>
<path stroke="#c89b70" stroke-width="${f(4 * k)}" d="M${f(-l / 4)} ${f(y0)}H${f(l / 4)}"/>
<path stroke="#4a86c5" stroke-width="${f(4 * k)}" d="M${f(left)} ${f(y0 - h)}H${f(l / 4 - d)}"/>
<path stroke="#8a8f98" stroke-dasharray="${f(4 * k)} ${f(4 * k)}" d="M${f(axis)} ${f(y0 - h)}V${f(y0)}"/></g>
${[-l / 4, l / 4].map((x) => `<path fill="none" stroke="#8a8f98" stroke-opacity=".45" stroke-width="${f(0.6 * k)}" d="M${f(2 * x - axis)} ${f(y0 - h)}L${f(x)} ${f(y0)}L${f(axis)} ${f(y0 - h)}"/>`).join("")}
${whole ? `<circle cx="${f(axis)}" cy="${f(y0 - r)}" r="${f(r)}" fill="#c4694f"/>` : `<path fill="#c4694f" d="M${f(axis - r)} ${f(y0)}a${f(r)} ${f(r)} 0 0 1 ${f(2 * r)} 0z"/>`}
<circle cx="${f(axis)}" cy="${f(y0 - h)}" r="${f(3 * k)}" fill="#8a8f98"/>
<g fill="none" stroke="#8a8f98" stroke-width="${f(0.6 * k)}">${arrow(left + 5 * k, y0 - h + 5 * k, left + 5 * k, y0 - 3 * k)}</g>
<rect x="${f(left)}" y="${f(y1 - l / 2)}" width="${f(l)}" height="${f(l)}" fill="#4a86c5" fill-opacity=".1" stroke="#4a86c5" stroke-width="${f(k)}" stroke-dasharray="${f(4 * k)} ${f(3 * k)}"/>
<rect x="${f(-l / 4)}" y="${f(y1 - l / 4)}" width="${f(l / 2)}" height="${f(l / 2)}" fill="#c89b70" fill-opacity=".3" stroke="#c89b70" stroke-width="${f(1.2 * k)}"/>
<circle cx="${f(axis)}" cy="${f(y1)}" r="${f(r)}" fill="#c4694f"/>
<g fill="none" stroke="#8a8f98" stroke-width="${f(0.6 * k)}">${arrow(l / 4 - d, y1 - l / 2 - 4 * k, axis, y1 - l / 2 - 4 * k)}</g>
<g class="words" font-size="${f(size)}" font-family="system-ui, sans-serif">${text((left + l / 4 - d) / 2, y0 - h - 6 * k, `pattern, ${mm(l)}`)}${text(0, y0 + 12 * k, "sample")}${text(axis, y0 + 12 * k, "ball")}${text(axis + 3 * k, y0 - h - 6 * k, "lens")}${text(left + 8 * k, y0 - h / 2, mm(h), "start")}${text(0, y1 + 3 * k, mm(l / 2))}${text((l / 4 - d + axis) / 2, y1 - l / 2 - 8 * k, mm(2 * d))}${text(left, low - 5 * k, "from above, as the photo shows it", "start")}</g></svg>`);
  return made;
}
