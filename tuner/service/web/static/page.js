"use strict";
(() => {
  document.documentElement.classList.add("scripted");

  const draw = (root) => {
    const charts = root.querySelector(".charts");
    if (charts) drawFigures(JSON.parse(charts.textContent), root);
  };
  draw(document);

  // parts of a page that move: fetched again when something happens, or every so often
  const renew = async (place) => {
    try {
      const answer = await fetch(place.dataset.fragment, { headers: { "X-Requested-With": "script" } });
      if (!answer.ok) return;
      const text = await answer.text();
      const log = place.querySelector(".log");
      const low = log && log.scrollTop + log.clientHeight > log.scrollHeight - 20;
      place.innerHTML = text;
      draw(place);
      const after = place.querySelector(".log");
      if (after && low) after.scrollTop = after.scrollHeight;
      if (place.querySelector("[data-ended]")) location.reload();
    } catch { /* the server is away: the next time */ }
  };
  for (const place of document.querySelectorAll("[data-fragment]")) {
    if (place.dataset.every) {
      setInterval(() => { if (!document.hidden && !place.contains(document.activeElement)) renew(place); }, Number(place.dataset.every));
    }
    if (place.dataset.events) {
      let waiting = 0;
      const soon = () => { if (!waiting) waiting = setTimeout(async () => { await renew(place); waiting = 0; }, 400); };
      const source = new EventSource(place.dataset.events);
      for (const kind of ["job", "message", "iteration", "state"]) source.addEventListener(kind, soon);
    }
  }

  // recordings: dropped or chosen, sent one after the other, each answered with its card
  const form = document.getElementById("upload");
  if (!form) return;
  const input = document.getElementById("file");
  const drop = form.querySelector(".drop");
  const uploads = document.getElementById("uploads");
  const chosen = document.getElementById("chosen");
  const start = document.getElementById("start");
  input.multiple = true;

  // flights that the settings hold out, as the server has answered: later cards are marked, too
  const held = document.querySelector("input[name=holdout]").value.split(" ").filter(Boolean);

  const show = (html) => {
    const made = document.createRange().createContextualFragment(html).querySelector("[data-recording]");
    if (!made) return;
    const before = chosen.querySelector(`[data-recording="${CSS.escape(made.dataset.recording)}"]`);
    if (before) before.replaceWith(made); else chosen.append(made);
    if (held.includes(made.dataset.flight)) made.querySelector("input[value=holdout]").checked = true;
    delete start.dataset.waits;
  };
  const send = (file) => new Promise((done) => {
    const line = document.createElement("p");
    const bar = document.createElement("progress");
    const cancel = document.createElement("button");
    const words = document.createElement("span");
    line.className = "uploading";
    cancel.textContent = "Cancel";
    words.textContent = `${file.name} `;
    line.append(words, bar, cancel);
    uploads.append(line);
    const request = new XMLHttpRequest();
    request.open("POST", "/recordings");
    request.setRequestHeader("X-Requested-With", "script");
    request.upload.onprogress = (event) => { bar.max = event.total; bar.value = event.loaded; };
    request.upload.onload = () => { bar.removeAttribute("value"); words.textContent = `${file.name} is being read `; };
    const end = (sentence) => {
      line.remove();
      if (sentence) {
        const problem = document.createElement("p");
        problem.className = "problem";
        problem.setAttribute("role", "alert");
        problem.textContent = sentence;
        uploads.append(problem);
      }
      done();
    };
    request.onload = () => {
      if (request.status === 200) { show(request.responseText); end(""); return; }
      const answer = document.createRange().createContextualFragment(request.responseText).querySelector(".problem");
      end(answer ? answer.textContent : `${file.name}: the server refused it; try again`);
    };
    request.onerror = () => end(`${file.name}: the upload was cut off; check the connection and try again`);
    request.onabort = () => end(`${file.name}: the upload was cancelled; nothing of it is kept`);
    cancel.type = "button";
    cancel.onclick = () => request.abort();
    const data = new FormData();
    data.append("file", file);
    request.send(data);
  });
  let queue = Promise.resolve();
  const take = (files) => {
    uploads.querySelectorAll(".problem").forEach((old) => old.remove());
    for (const file of files) {
      if (/\.ya?ml$/i.test(file.name)) {
        file.text().then((text) => {
          const area = document.querySelector("textarea[name=settings]");
          area.value = text;
          area.closest("details").open = true;
        });
      } else queue = queue.then(() => send(file));
    }
  };
  input.addEventListener("change", () => { take([...input.files]); input.value = ""; });
  for (const kind of ["dragenter", "dragover"]) document.addEventListener(kind, (event) => { event.preventDefault(); drop.classList.add("over"); });
  for (const kind of ["dragleave", "drop"]) document.addEventListener(kind, () => drop.classList.remove("over"));
  document.addEventListener("drop", (event) => { event.preventDefault(); if (event.dataTransfer) take([...event.dataTransfer.files]); });
  for (const link of document.querySelectorAll("[data-add]")) {
    link.addEventListener("click", async (event) => {
      event.preventDefault();
      const answer = await fetch(`/recordings/${link.dataset.add}/card`);
      if (answer.ok) { show(await answer.text()); link.closest("li").remove(); }
    });
  }
})();
