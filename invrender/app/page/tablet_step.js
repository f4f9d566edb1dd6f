// Step 2: the pattern on the tablet, in step with this page.
import { h, api, attempt, onChange } from "./ui.js";
import { state, chosen } from "./state.js";

export const NAMES = { default: "The coloured pattern", turned: "The coloured pattern, turned", stripes: "Stripes", left: "Left half white", upper: "Upper half white" };

export const show = (pattern) => api("/api/shown", "POST", { pattern, profile: chosen().id });

// Buttons for the patterns that a capture wants, one after another; a function that keeps them right.
export const chooser = (into) => onChange(() => [state.shown.pattern, chosen().photos], () => into.replaceChildren(patternButtons() || ""));

function patternButtons() {
  const wanted = chosen().photos > 1 ? state.patterns : state.patterns.slice(0, 1);
  if (wanted.length < 2) return null;
  return h("fieldset", {}, h("legend", {}, "The tablet shows"), h("div.choice", {}, wanted.map((name, i) =>
    h("button", { type: "button", "aria-pressed": String(state.shown.pattern === name), onclick: (e) => attempt(() => show(name), e.target) }, `${i + 1}. ${NAMES[name]}`))));
}

export function tablet(main) {
  attempt(() => show("default"));
  const patterns = h("div");
  const tablet = state.links.tablet
    ? h("div.qr", {}, h("img", { src: "/qr/tablet.svg", alt: "QR code of the pattern's page" }), h("p", {}, "Scan it with the tablet's camera. The pattern's page opens."))
    : h("div.stack", {}, h("h2", {}, "Is the tablet another device?"),
      h("p", {}, "Start the program as ", h("code.command", {}, "invrender app --lan"), ": then a QR code here opens the pattern on the tablet, and another one this page on the phone. It opens the port to your network, guarded by the key in the code, but not encrypted."),
      h("p.soft", {}, "Or open the pattern on this machine's own display:"));
  main.append(h("h1", {}, "Tablet"), h("p.lead", {}, "It shows a light pattern at its real size, mirrored, since the sample looks at it from below."),
    h("div.split", {},
      h("div.sheet.stack", {}, h("ol", {},
        h("li", {}, "Open the pattern's page on the tablet."),
        h("li", {}, "Full brightness. Switch off automatic brightness, night light and tone adaptation."),
        h("li", {}, "Touch “Show the pattern”: full screen, and it stays awake where the browser allows."),
        h("li", {}, `Turn the tablet face down, ${chosen().height}\u00a0mm above the table.`)),
        patterns,
        h("div.actions", {}, h("a.button.primary", { href: "#/photo", id: "tablet-next" }, "Continue"))),
      h("aside.sheet", {}, tablet,
        h("div.actions", {}, h("a.button", { href: `/tablet?profile=${chosen().id}`, target: "_blank", rel: "noopener" }, "Open the pattern here")))));
  const draw = chooser(patterns);
  draw();
  return { update: draw };
}
