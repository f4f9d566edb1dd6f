// Step 5: the material as other programs want it.
import { h, api, attempt, bytes, percent, sentence } from "./ui.js";
import { captureOf } from "./state.js";

// [target, name, what it is for, file's ending, has a place for height]
const TARGETS = [
  ["gltf", "glTF", "A rectangle of the sample's size, for viewers, the web and three.js.", ".glb", false],
  ["usd", "USD", "OpenPBR and UsdPreviewSurface, for Omniverse, Houdini and the iPhone's viewer.", ".usdz", true],
  ["materialx", "MaterialX", "OpenPBR and standard surface, with textures.", ".zip", true],
  ["blender", "Blender", "A script that builds the material, with textures.", ".zip", true],
  ["unreal", "Unreal Engine", "Packed textures, DirectX normals.", ".zip", true],
  ["unity", "Unity", "Specular workflow, smoothness in alpha.", ".zip", true],
  ["godot", "Godot", "Albedo, packed ORM, normal.", ".zip", true],
  ["ambientcg", "ambientCG", "That library's file names.", ".zip", true],
  ["polyhaven", "Poly Haven", "That library's file names.", ".zip", true],
  ["mitsuba", "Mitsuba 3", "A scene with the captured room, for research.", ".zip", false],
];

export function take(main, id) {
  const c = captureOf(id);
  const tileable = h("input", { type: "checkbox", id: "tileable" }), height = h("input", { type: "checkbox", id: "height" });
  const licence = h("input", { id: "licence", placeholder: "CC0-1.0", maxlength: 80 });
  const pictures = h("div"), list = h("ul.targets");
  async function fetch_it(target, cost) {
    cost.textContent = "Writing …";
    try {
      const done = await api(`/api/captures/${id}/export`, "POST", { target, tileable: tileable.checked,
        height: height.checked && TARGETS.find((t) => t[0] === target)[4], licence: licence.value });
      const error = Math.min(...Object.values(done.errors).map((e) => e.rerender));
      cost.textContent = `${done.file}, ${bytes(done.bytes)}. It looks ${error < 0.0005 ? "the same" : `within ${percent(error, 1)}`} when rendered.`;
      const link = h("a", { href: `/captures/${id}/exports/${encodeURIComponent(done.file)}`, download: done.file });
      document.body.append(link); link.click(); link.remove();
    } catch (error) { cost.textContent = sentence(error.message); }
  }
  for (const [target, name, words, ending] of TARGETS) {
    const cost = h("div.cost", { role: "status" });
    const button = h("button", { type: "button", id: `to-${target}`, onclick: () => attempt(() => fetch_it(target, cost), button) }, `Download ${ending}`);
    if (target === "gltf") button.className = "primary";
    list.append(h("li", {}, h("h2", {}, name), h("p", {}, words), h("div", {}, button, cost)));
  }
  const preview = h("button", { type: "button", id: "preview", onclick: () => attempt(async () => {
    const t = await api(`/api/captures/${id}/tile`, "POST"), now = Date.now(), at = (n) => `/captures/${id}/${n}.jpg?${now}`;
    const picture = (n, title, text) => h("figure", {}, h("img", { src: at(n), alt: title }), h("figcaption", {}, `${title}. ${text}`));
    pictures.replaceChildren(h("div.pair", {}, picture("repeated", "Repeated as it is", `Steps at the border are ${t.seams.before.toFixed(1)} times those inside.`),
      picture("tile", "Seamless", `${t.seams.after.toFixed(1)} times; ${percent(t.seams.replaced)} of the pixels come from elsewhere in the sample.`),
      picture("height", "Height", `From black to white ${(1000 * t.span).toPrecision(2)} mm; no surface explains ${percent(t.outliers, 1)} of the slopes.`)));
  }, preview) }, "Preview seamless and height");
  main.append(h("h1", {}, `Take “${c.name}” away`), h("p.lead", {}, "Every file knows its colour space and its size in metres. What the conversion costs is measured as it is written."),
    h("div.sheet.stack", {}, h("div.fields", {},
      h("div", {}, h("label.check", { for: "tileable" }, tileable, "Seamless, to be repeated"), h("label.check", { for: "height" }, height, "With height and ambient occlusion")),
      h("div.field", {}, h("label", { for: "licence" }, "Licence, written beside the files"), licence),
      h("div", {}, preview)), pictures),
    list,
    h("p.soft.small", {}, "Maps as EXR, the report and everything else are in the capture's folder."));
  list.style.marginTop = "1.5rem";
  return {};
}
