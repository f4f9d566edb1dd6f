"use strict";
// The pattern's page follows what the other pages choose. It runs beside page.js.
(() => {
  const image = document.getElementById("pattern");
  const listen = () => {
    const events = new EventSource("/api/events");
    const show = (shown) => { image.src = `/patterns/${shown.pattern}.png`; };
    events.addEventListener("state", (e) => show(JSON.parse(e.data).shown));
    events.addEventListener("shown", (e) => show(JSON.parse(e.data)));
    events.onerror = () => { if (events.readyState === EventSource.CLOSED) setTimeout(listen, 2000); };
  };
  listen();
})();
