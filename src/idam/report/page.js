"use strict";
// One registration: two clouds before and after, the matches between them, and the answers to choose from.

const scene = sceneOfPage();
const clouds = [], floats = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
const matches = {
  ends: floats(scene.matches.ends), // per match: source xyz, target xyz, from weak to strong
  weights: floats(scene.matches.weights),
};
matches.count = matches.weights.length;
matches.eliminated = matches.weights.filter((weight) => !(weight > 0)).length;
matches.kept = matches.count - matches.eliminated;

const VIRIDIS = ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"];
const RESTING = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]];
let viewer;

// What the views show

/** The source, the target, and both, as the slider between them blends them. */
function layers(view) {
  const pale = matchesShown(view.id) ? 0.55 : 0; // behind matches the clouds stand back
  const members = clouds.map((cloud) => cloud.name === "source"
    ? { cloud, pose: view.pose, place: view.place, pale }
    : { cloud, pose: RESTING, place: RESTING, pale });
  const shown = members.filter(({ cloud }) => element(`show-${cloud.name}`).checked);
  const share = Number(element("blend").value) / 50 - 1; // -1: the source alone, 1: the target alone
  if (shown.length < 2 || share === 0) return [[shown, 1]];
  const alone = [shown[share < 0 ? 0 : 1]];
  return Math.abs(share) === 1 ? [[alone, 1]] : [[alone, 1], [shown, 1 - Math.abs(share)]];
}

function subject(id) {
  const view = { id, ...(id === "before" ? scene.before : scene.answers[element("answer").selectedIndex]) };
  const lines = matchesShown(id) ? { ...matches, runs: chosenMatches(), from: view.pose, to: RESTING } : null;
  return { radius: view.radius, centre: view.centre, layers: layers(view), lines };
}

const matchesShown = (id) => matches.count > 0 && element(`matches-${id}`).checked;

function chosenMatches() { // runs of [first, count]
  const strongest = Math.min(Number(element("strongest").value), matches.kept);
  const runs = [[matches.count - strongest, strongest]];
  if (element("show-eliminated").checked) runs.unshift([0, matches.eliminated]);
  return runs.filter(([, count]) => count > 0);
}

// Colours

function readColours() {
  for (const cloud of clouds) cloud.colour = themeColour(cloud.name);
  const dark = darkTheme.matches && !document.documentElement.classList.contains("printing");
  const ramp = dark ? VIRIDIS.slice(2) : VIRIDIS.slice(0, -1).reverse(); // the strong stand out from the background
  const stops = ramp.map(parse), eliminated = themeColour("eliminated");
  matches.tints = new Float32Array(matches.count * 3);
  matches.weights.forEach((weight, i) => matches.tints.set(weight > 0 ? onRamp(weight, stops) : eliminated, 3 * i));
  element("ramp").style.background = `linear-gradient(90deg, ${ramp.join()})`;
}

function onRamp(weight, stops) {
  const place = weight / matches.weights[matches.count - 1] * (stops.length - 1);
  const i = Math.min(Math.floor(place), stops.length - 2);
  return mix(stops[i], stops[i + 1], place - i);
}

// The controls

function setUpControls() {
  element("match-controls").hidden = matches.count === 0;
  element("eliminated").hidden = matches.eliminated === 0;
  element("strongest").max = Math.max(1, matches.kept);
  element("strongest").value = Math.min(matches.kept, 100);
  element("heaviest").textContent = scene.matches.strongest;
  element("answer-choice").hidden = scene.answers.length < 2;
  const { gap } = scene.before;
  element("gap").textContent = gap && `drawn closer together: as given, they lie ${gap} apart`;
  element("controls").addEventListener("input", describe);
  element("copy").addEventListener("click", copyMatrix);
}

function describe() {
  const shown = ["before", "after"].some(matchesShown), { selectedIndex } = element("answer");
  for (const id of ["strongest", "show-eliminated"]) element(id).disabled = !shown;
  element("blend").disabled = !(element("show-source").checked && element("show-target").checked);
  element("strongest-count").textContent = `${Math.min(Number(element("strongest").value), matches.kept)} of ${matches.kept}`;
  for (const part of document.querySelectorAll("[data-answer]")) part.hidden = Number(part.dataset.answer) !== selectedIndex;
  element("other").textContent = selectedIndex > 0 ? "another answer than the one given" : "";
}

async function copyMatrix() {
  const text = document.querySelector(".matrix:not([hidden])").dataset.text;
  try {
    await navigator.clipboard.writeText(text);
  } catch { // some browsers keep the clipboard from pages opened as files
    const area = document.body.appendChild(document.createElement("textarea"));
    area.value = text;
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  element("copy").textContent = "Copied";
  setTimeout(() => { element("copy").textContent = "Copy"; }, 1500);
}

async function start() {
  for (const name of ["source", "target"]) clouds.push(await unpacked(scene[name], name));
  setUpControls();
  describe();
  viewer = new Viewer({ ids: ["before", "after"], up: scene.up, clouds, subject, theme: readColours });
}

const ready = begun(start());
