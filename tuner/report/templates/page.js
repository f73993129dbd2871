"use strict";
(async () => {
  for (const place of document.querySelectorAll("[data-drawn]")) {
    delete place.dataset.drawn; // of a page that was saved from a browser
    place.querySelector(".plot")?.replaceChildren();
  }
  const open = () => {
    const place = document.getElementById(location.hash.slice(1));
    if (place?.localName === "details") place.open = true;
  };
  addEventListener("hashchange", open);
  open();

  const unpack = async (id) => {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  await new Promise((resolve) => setTimeout(resolve, 0)); // the text first
  const [library, charts] = await Promise.all([unpack("library"), unpack("figures").then(JSON.parse)]);
  const script = document.createElement("script");
  script.textContent = library;
  document.head.appendChild(script);
  drawFigures(charts);
  document.body.dataset.ready = "yes";
})();
