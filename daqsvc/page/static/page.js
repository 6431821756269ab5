// Puts what the server tells into the page: figures, tables, and how old all of it is.
"use strict";
const live = document.getElementById("live");
const sources = {};
let frozen = false;
let heard = performance.now();
let told = { age_s: 0, why: "" };

const floats = (sent) =>
  Array.isArray(sent) ? sent : new Float32Array(Uint8Array.from(atob(sent.f4), (c) => c.charCodeAt(0)).buffer);

function inOwnZone(root) {
  for (const time of root.querySelectorAll("time")) {
    time.textContent = new Date(time.dateTime).toLocaleString([], { dateStyle: "short", timeStyle: "medium" });
  }
}

function show(now) {
  for (const [id, html] of Object.entries(now.html ?? {})) {
    const place = document.querySelector(id === "head" ? "#head" : `#${id} tbody`);
    if (place && place.dataset.shown !== html) {
      place.dataset.shown = html;
      place.innerHTML = html;
      inOwnZone(place);
    }
  }
  for (const [name, columns] of Object.entries(now.sources ?? {})) {
    if (sources[name]) {
      sources[name].data = Object.fromEntries(Object.entries(columns).map(([key, sent]) => [key, floats(sent)]));
    }
  }
  const rows = document.querySelector("#rows tbody");
  if (rows && now.rows) {
    rows.replaceChildren(
      ...now.rows.map((cells) => {
        const row = document.createElement("tr");
        row.append(
          ...cells.map((text, at) => {
            const cell = document.createElement(at ? "td" : "th");
            if (!at) cell.scope = "row";
            cell.textContent = text;
            return cell;
          }),
        );
        return row;
      }),
    );
  }
  const note = document.getElementById("note");
  if (note && note.textContent !== (now.note ?? "")) note.textContent = now.note ?? "";
}

// What is not heard any more is grey, with its age: no number looks live that is not.
function sayAge() {
  const away_s = (performance.now() - heard) / 1000;
  const age_s = away_s > 3 ? away_s + told.age_s : told.age_s;
  const silent = away_s > 3 || told.why !== "";
  const why = away_s > 3 ? "the page's server does not answer" : told.why;
  const place = document.getElementById("silence");
  document.body.classList.toggle("stale", silent);
  place.hidden = !silent && !frozen;
  const text = silent ? `What is shown is ${Math.round(age_s)} s old: ${why}.` : frozen ? "Frozen: press Freeze again to go on." : "";
  if (place.textContent !== text) place.textContent = text;
}

async function figures() {
  const theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  const query = new URLSearchParams(location.search);
  query.set("theme", theme);
  const answer = await fetch(`${live.dataset.figures}?${query}`);
  if (!answer.ok) {
    document.getElementById("note").textContent = "The figures cannot be made: load the page anew.";
    return;
  }
  const made = await answer.json();
  const place = document.getElementById("figures");
  for (const one of made) {
    const figure = document.createElement("figure");
    figure.setAttribute("role", "img");
    figure.setAttribute("aria-label", one.label);
    const box = document.createElement("div");
    box.id = one.item.target_id;
    figure.append(box);
    place.append(figure);
    const manager = await Bokeh.embed.embed_item(one.item);
    for (const model of manager.roots[0].model.document.all_models ?? manager.roots[0].model.document._all_models.values()) {
      if (model.type === "ColumnDataSource" && model.name) sources[model.name] = model;
    }
  }
}

function listen() {
  const events = new EventSource(live.dataset.events + location.search);
  events.onmessage = (event) => {
    heard = performance.now();
    told = JSON.parse(event.data);
    if (!frozen) show(told);
    sayAge();
  };
}

async function watchPlant(list) {
  try {
    const now = await (await fetch("/plant.json")).json();
    heard = performance.now();
    told = { age_s: 0, why: now.why };
    const text = JSON.stringify(now.tiles);
    if (list.dataset.shown !== undefined && list.dataset.shown !== text) location.reload();
    list.dataset.shown = text;
  } catch {
    // The age says it.
  }
  setTimeout(() => watchPlant(list), 2000);
}

const plant = document.querySelector("[data-plant]");
if (plant) watchPlant(plant);
if (live) {
  (live.dataset.figures ? figures() : Promise.resolve()).then(listen);
  const freeze = document.getElementById("freeze");
  freeze?.addEventListener("click", () => {
    frozen = !frozen;
    freeze.setAttribute("aria-pressed", String(frozen));
    sayAge();
  });
  for (const select of document.querySelectorAll(".choices select")) {
    select.addEventListener("change", () => select.form.submit());
  }
}
setInterval(sayAge, 1000);
