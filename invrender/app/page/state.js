// What all steps share: the captures, rigs and patterns as the server tells them, and what is done
// with a capture from more than one step.
import { api, toast, go } from "./ui.js";

const saved = { get: (k) => { try { return localStorage.getItem("invrender." + k); } catch { return null; } },
  set: (k, v) => { try { localStorage.setItem("invrender." + k, v); } catch { /* private window */ } } };

export const state = { captures: [], profiles: [], profile: saved.get("profile") };

export const captureOf = (id) => state.captures.find((c) => c.id === id);
export function chosen() {
  return state.profiles.find((p) => p.id === state.profile) || state.profiles[0];
}
export function choose(id) { state.profile = id; saved.set("profile", id); }

export function takeIn(capture) {
  const at = state.captures.findIndex((c) => c.id === capture.id);
  if (at >= 0) state.captures[at] = capture;
  else state.captures.unshift(capture);
  state.captures.sort((a, b) => (a.id < b.id ? 1 : -1));
}

export async function discard(capture) {
  await api(`/api/captures/${capture.id}`, "DELETE");
  toast(`“${capture.name}” is in the trash.`, () => api(`/api/captures/${capture.id}/restore`, "POST"), "Bring it back");
}
export async function example() {
  const made = await api("/api/captures?example=1", "POST");
  takeIn(made);
  go(`#/c/${made.id}`);
}
