// Elements, requests and messages: what every step uses.

// An element: h("a.button", { href: "…" }, "text", other). Functions are event listeners.
export function h(name, values = {}, ...children) {
  const [tag, ...classes] = name.split(".");
  const made = document.createElement(tag || "div");
  if (classes.length) made.className = classes.join(" ");
  for (const [key, value] of Object.entries(values)) {
    if (value === undefined || value === null || value === false) continue;
    if (typeof value === "function") made.addEventListener(key.slice(2), value);
    else if (key in made && typeof value !== "string") made[key] = value;
    else made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.flat(9).filter((c) => c !== null && c !== undefined && c !== false));
  return made;
}

// An SVG from text that is ours alone.
export function drawing(text) {
  return new DOMParser().parseFromString(text, "image/svg+xml").documentElement;
}

export function svg(tag, values = {}) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(values)) made.setAttribute(key, value);
  return made;
}

export function toast(text, action, label) {
  const close = () => made.remove();
  const made = h("div.toast", {}, h("span", {}, text),
    action && h("button", { type: "button", onclick: () => { close(); action(); } }, label));
  document.getElementById("toasts").append(made);
  setTimeout(close, action ? 12000 : 8000);
}

// A function that draws only when what it shows has changed: an element that is made anew between a
// press and its release gets no click.
export function onChange(shown, draw) {
  let last;
  return () => {
    const now = JSON.stringify(shown());
    if (now === last) return;
    last = now;
    draw();
  };
}

export const sentence = (text) => text ? text[0].toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".") : "";

// Ask the server; what it refuses is an error with its sentence.
export async function api(path, method = "GET", body) {
  let answer;
  try {
    answer = await fetch(path, { method, body: body === undefined ? undefined : JSON.stringify(body),
      headers: body === undefined ? {} : { "content-type": "application/json" } });
  } catch { throw new Error("the program does not answer: is it still running?"); }
  if (answer.status === 204) return null;
  const text = await answer.text();
  let value = null;
  try { value = JSON.parse(text); } catch { /* not JSON */ }
  if (answer.ok) return value;
  throw new Error((value && value.problem) || (answer.status === 401
    ? "this page is locked: open the address that the program printed" : text.slice(0, 200)));
}

// Do something that may fail; its sentence is shown.
export async function attempt(work, button) {
  if (button) button.disabled = true;
  try { return await work(); } catch (error) { toast(sentence(error.message)); return undefined; }
  finally { if (button) button.disabled = false; }
}

export const go = (to) => { location.hash = to; };
export const bytes = (n) => n > 1e6 ? `${(n / 1e6).toFixed(1)} MB` : `${Math.max(1, Math.round(n / 1e3))} kB`;
export const percent = (x, digits = 0) => `${(100 * x).toFixed(digits)}%`;
