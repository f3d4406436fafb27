// What the keyboard gets to should speak, and arrow keys should go from cell to cell.
"use strict";

// Quasar gives the role of a slider to an element that never gets the focus
const spoken = ["aria-label", "aria-valuemin", "aria-valuemax", "aria-valuenow", "aria-orientation"];

function say(element, name, text) {
  // Only what is new: the observer sees this, too
  if (text !== null && element.getAttribute(name) !== text) element.setAttribute(name, text);
}

function speak() {
  for (const slider of document.querySelectorAll(".q-slider")) {
    const focused = slider.querySelector(".q-slider__track-container");
    say(focused, "role", "slider");
    for (const name of spoken) say(focused, name, slider.getAttribute(name));
    say(slider, "role", "presentation");
  }
}

new MutationObserver(speak).observe(document, { subtree: true, childList: true, attributeFilter: ["role", ...spoken] });

const steps = { ArrowUp: [-1, 0], ArrowRight: [0, 1], ArrowDown: [1, 0], ArrowLeft: [0, -1] };

// Of the 25 cells only the chosen one is a stop of the tab key; to go to another one is to choose it
addEventListener("keydown", event => {
  const cell = event.target.closest?.(".cells > .cell"), step = steps[event.key];
  if (!cell || !step || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  const cells = [...cell.parentElement.children], size = Math.sqrt(cells.length), place = cells.indexOf(cell);
  const row = Math.floor(place / size) + step[0], column = place % size + step[1];
  if (row < 0 || column < 0 || row >= size || column >= size) return;
  const next = cells[row * size + column];
  next.focus();
  next.click();
});
