"use strict";
// Many scans put together: all of them before and after, each with a switch, and tables to sort.

const scene = sceneOfPage(), scans = [];
const switches = [...document.querySelectorAll(".show")];
const shown = new Set(switches.filter((each) => each.checked).map((each) => Number(each.dataset.scan)));
let viewer;

/** All scans as given, or those of the chosen component. */
function subject(id) {
  const before = id === "before", view = before ? scene.before : scene.views[element("component").selectedIndex];
  if (!view) return { ...scene.before, layers: [[[], 1]] };
  const inside = scans.filter(({ number, component }) => shown.has(number) && (before || component === view.component));
  const members = inside.map((cloud) => ({
    cloud, pose: before ? cloud.before : cloud.after, place: before ? cloud.given : cloud.after,
  }));
  return { radius: view.radius, centre: view.centre, layers: [[members, 1]] };
}

function setUpControls() {
  for (const each of switches) {
    each.addEventListener("change", () => {
      shown[each.checked ? "add" : "delete"](Number(each.dataset.scan));
      viewer.redraw();
    });
  }
  for (const [id, on] of [["all", true], ["none", false]]) {
    element(id).addEventListener("click", () => {
      for (const each of switches) if (!each.disabled && each.checked !== on) each.click();
    });
  }
  element("rejected").addEventListener("change", ({ target }) => {
    element("graph").classList.toggle("used-only", !target.checked);
  });
  for (const { component } of scene.views) element("component").add(new Option(component));
  element("choice").hidden = scene.views.length < 2;
  element("apart").textContent = scene.apart ? "side by side: as given, they are too far apart to be seen" : "";
  document.querySelectorAll("#links th").forEach(sortable);
}

/** Sorts the links by a column when its head is clicked. */
function sortable(head, column) {
  let up = 1;
  head.addEventListener("click", () => {
    const body = document.querySelector("#links tbody"), cell = (row) => row.cells[column];
    const key = (row) => cell(row).dataset.value === undefined ? cell(row).textContent : Number(cell(row).dataset.value);
    const order = (a, b) => (key(a) > key(b) ? 1 : key(a) < key(b) ? -1 : 0) * up;
    body.append(...[...body.rows].sort(order));
    up = -up;
  });
}

async function start() {
  for (const [number, scan] of scene.scans.entries()) {
    if (!scan) continue;
    const { before, after, given, component } = scan;
    scans.push({ ...await unpacked(scan.cloud, scan.name, parse(scan.color)), number, before, after, given, component });
  }
  setUpControls();
  viewer = new Viewer({ ids: ["before", "after"], up: scene.up, clouds: scans, subject });
}

const ready = begun(start());
