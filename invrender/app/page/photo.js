// Step 3, first half: photos in, by drag and drop, from the disk or from the phone.
import { h, attempt, go, sentence, toast } from "./ui.js";
import { state, chosen, example, takeIn } from "./state.js";
import { chooser, show } from "./tablet_step.js";

const WAIT = 1000; // ms, where the server says that it is too fast

export function upload(file, values, tell = () => {}) {
  const query = new URLSearchParams({ file: file.name, ...values });
  return new Promise((done, fail) => {
    const request = new XMLHttpRequest();
    request.open("POST", `/api/captures?${query}`);
    request.setRequestHeader("content-type", "application/octet-stream");
    request.upload.onprogress = (e) => tell(e.loaded / Math.max(e.total, 1));
    request.onerror = () => fail(new Error("the program does not answer"));
    request.onload = () => {
      let answer = null;
      try { answer = JSON.parse(request.responseText); } catch { /* text */ }
      if (request.status === 201) done(answer);
      else if (request.status === 429) setTimeout(() => upload(file, values, tell).then(done, fail), WAIT);
      else fail(new Error(answer?.problem || request.responseText.slice(0, 200)));
    };
    request.send(file);
  });
}

export function photo(main) {
  const list = h("ul.uploads"), patterns = h("div"), together = chosen().photos > 1;
  let into = null; // the capture that further photos of the same sample join
  const one = async (file, pattern) => {
    const meter = h("i"), words = h("span.small.soft", {}, "");
    const row = h("li", {}, h("span", {}, `${file.name} `), words, h("div.meter", {}, meter));
    list.append(row);
    try {
      const made = await upload(file, { profile: chosen().id, pattern, ...(into ? { capture: into } : {}) },
        (share) => { meter.style.width = `${100 * share}%`; });
      meter.style.width = "100%";
      takeIn(made);
      return made;
    } catch (error) { words.textContent = sentence(error.message); words.className = "small"; toast(sentence(`${file.name}: ${error.message}`)); return null; }
  };
  const add = async (files) => {
    const made = [];
    for (const file of files) {
      const pattern = state.shown.pattern;
      const capture = await one(file, pattern);
      if (!capture) continue;
      made.push(capture);
      if (!together) continue;
      into = capture.id;
      const next = state.patterns[state.patterns.indexOf(pattern) + 1];
      if (next) { await attempt(() => show(next)); state.shown.pattern = next; draw(); }
    }
    if (together && made.length && made.at(-1).photos.length < chosen().photos) return;
    if (made.length === 1 || together) go(`#/c/${made[0]?.id || into}`);
    else if (made.length) go("#/");
  };
  const input = h("input", { type: "file", id: "file", multiple: true, "aria-label": "Photos",
    accept: "image/*,.dng,.cr2,.cr3,.nef,.arw,.raf,.orf,.rw2,.pef,.exr,.hdr,.heic,.tif,.tiff",
    onchange: () => { const files = [...input.files]; input.value = ""; add(files); } });
  const drop = h("div.drop", {},
    h("b.drops", {}, "Drop photos here"), h("span.soft", {}, "Raw is best; HEIC, JPEG, PNG, TIFF and EXR are fine."),
    h("label.button.primary", { for: "file" }, "Choose photos"), input,
    h("button.plain", { type: "button", id: "use-example", onclick: (e) => attempt(example, e.target) }, "Use the example photo"));
  for (const kind of ["dragenter", "dragover"]) drop.addEventListener(kind, (e) => { e.preventDefault(); drop.classList.add("over"); });
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (e) => { e.preventDefault(); drop.classList.remove("over"); add([...e.dataTransfer.files]); });
  main.append(h("h1", {}, "Photo"), h("p.lead", {}, "Look straight down, the ball in the middle, the whole sample in view. Expose so that neither the sample nor the pattern in the ball is white."),
    h("div.split", {}, h("div.stack", {}, patterns, drop, list),
      h("aside.sheet.stack", {}, state.links.phone
        ? h("div.qr", {}, h("img", { src: "/qr/phone.svg", alt: "QR code of this page" }), h("p", {}, "Scan it with the phone: this page opens there, and takes its photos."))
        : h("p.soft", {}, "Started as ", h("code.command", {}, "invrender app --lan"), ", the program shows a QR code here that opens this page on the phone."),
      h("div", {}, h("h2", {}, "A good photo"), h("ul", {}, ["24 mm lens, no zoom, no flash, no filters", "focus on the sample, and lock it", "hands and head out of the ball's view", "a dim room is better than a bright one"].map((t) => h("li", {}, t)))))));
  const draw = chooser(patterns);
  draw();
  return { update: draw };
}
