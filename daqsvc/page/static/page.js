// Puts what the server tells into the page: figures, tables, and how old all of it is.
"use strict";
const live = document.getElementById("live");
const sources = {};
let frozenAt = null;
let token = null;
let heard = performance.now();
let told = { age_s: 0, why: "" };

const floats = (sent) =>
  Array.isArray(sent) ? sent : new Float32Array(Uint8Array.from(atob(sent.f4), (c) => c.charCodeAt(0)).buffer);

function inOwnZone(root) {
  for (const time of root.querySelectorAll("time")) {
    time.textContent = new Date(time.dateTime).toLocaleString([], { dateStyle: "short", timeStyle: "medium" });
  }
}

// On a phone the rows of a table are cards, in which each cell has its title.
function labelled(rows) {
  for (const row of rows) {
    const heads = row.closest("table").tHead?.rows[0]?.cells ?? [];
    if (row.cells.length === heads.length) {
      [...row.cells].forEach((cell, at) => (cell.dataset.label = heads[at].textContent));
    }
  }
}

function show(now) {
  for (const [id, html] of Object.entries(now.html ?? {})) {
    const place = document.querySelector(id === "head" ? "#head" : `#${id} tbody`);
    if (place && place.dataset.shown !== html) {
      place.dataset.shown = html;
      place.innerHTML = html;
      inOwnZone(place);
      if (place.rows) labelled(place.rows);
    }
  }
  if (frozenAt) return;
  for (const [name, source] of Object.entries(sources)) {
    // What was not sent is not there: no old curve stays under a note.
    const columns = now.sources?.[name] ?? Object.fromEntries(Object.keys(source.data).map((key) => [key, []]));
    source.data = Object.fromEntries(Object.entries(columns).map(([key, sent]) => [key, floats(sent)]));
  }
  const rows = document.querySelector("#rows tbody");
  if (rows) {
    rows.replaceChildren(
      ...(now.rows ?? []).map((cells) => {
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
  place.hidden = !silent && !frozenAt;
  const frozen = frozenAt ? `The figures are frozen since ${frozenAt}: press Freeze again to go on. ` : "";
  const text = frozen + (silent ? `What is shown is ${Math.round(age_s)} s old: ${why}.` : "");
  if (place.textContent !== text) place.textContent = text;
}

async function figures() {
  const theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  const query = new URLSearchParams(location.search);
  query.set("theme", theme);
  let made = [];
  while (!made.length) {
    try {
      made = await (await fetch(`${live.dataset.figures}?${query}`)).json();
    } catch {
      // The age shows that there is no answer.
    }
    if (!made.length) await new Promise((then) => setTimeout(then, 2000));
  }
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

let events = null;

function listen() {
  // A browser has few connections to a server: tabs that are hidden close theirs.
  if (document.hidden) return;
  events = new EventSource(live.dataset.events + location.search);
  events.onmessage = (event) => {
    heard = performance.now();
    told = JSON.parse(event.data);
    if (token !== null && told.token !== undefined && told.token !== token) location.reload();
    token = told.token ?? token;
    show(told);
    sayAge();
  };
}

let good = heard;

// The tiles again, without the page jumping, or the keyboard losing its place.
async function renew(list) {
  const page = new DOMParser().parseFromString(await (await fetch(location.href)).text(), "text/html");
  const held = list.contains(document.activeElement) ? document.activeElement.getAttribute("href") : null;
  list.innerHTML = page.querySelector("[data-plant]").innerHTML;
  if (held) [...list.querySelectorAll("a")].find((link) => link.getAttribute("href") === held)?.focus();
}

async function watchPlant(list) {
  try {
    const now = await (await fetch(`/plant.json${location.search}`)).json();
    heard = performance.now();
    if (!now.why) good = heard;
    told = { age_s: (heard - good) / 1000, why: now.why };
    const text = JSON.stringify(now.tiles);
    if (!now.why && list.dataset.shown !== undefined && list.dataset.shown !== text) await renew(list);
    if (!now.why || list.children.length === 0) list.dataset.shown = text;
  } catch {
    // The age shows it.
  }
  setTimeout(() => watchPlant(list), 2000);
}

const again = document.querySelector("[data-again-s]");
if (again) setTimeout(() => location.reload(), 1000 * again.dataset.againS);
const plant = document.querySelector("[data-plant]");
if (plant) watchPlant(plant);
if (live) {
  if (live.dataset.figures) figures();
  listen();
  document.addEventListener("visibilitychange", () => {
    events?.close();
    listen();
  });
  const freeze = document.getElementById("freeze");
  freeze?.addEventListener("click", () => {
    frozenAt = frozenAt ? null : new Date().toLocaleTimeString();
    freeze.setAttribute("aria-pressed", String(frozenAt !== null));
    sayAge();
  });
}
inOwnZone(document);
for (const table of document.querySelectorAll(".wide table")) labelled(table.tBodies[0].rows);
setInterval(sayAge, 1000);
