"use strict";
// Photograph | render: the slider moves the edge between them.
for (const box of document.querySelectorAll(".compare")) {
  const slider = box.querySelector("input");
  slider.addEventListener("input", () => box.style.setProperty("--at", `${slider.value}%`));
}
// A click shows a picture as large as the window.
const dialog = document.querySelector("dialog");
for (const image of document.querySelectorAll("img.zoom")) {
  image.addEventListener("click", () => {
    const large = dialog.querySelector("img");
    large.src = image.src;
    large.alt = image.alt;
    dialog.showModal();
  });
}
dialog.addEventListener("click", () => dialog.close());
// A click on the head of a column sorts by it.
for (const table of document.querySelectorAll("table.sort")) {
  const body = table.tBodies[0];
  const rows = [...body.rows].filter((row) => !row.classList.contains("sum"));
  table.querySelectorAll("thead th").forEach((head, column) => {
    const button = document.createElement("button");
    button.append(...head.childNodes);
    head.append(button);
    let down = false;
    button.addEventListener("click", () => {
      down = !down;
      const value = (row) => row.cells[column].dataset.v ?? row.cells[column].textContent.trim();
      rows.sort((a, b) => {
        const [x, y] = [value(a), value(b)];
        const order = isNaN(x) || isNaN(y) ? x.localeCompare(y) : x - y;
        return down ? -order : order;
      });
      rows.forEach((row) => body.insertBefore(row, body.querySelector("tr.sum")));
    });
  });
}
// On paper everything is unfolded, and folded again afterwards.
let folded = [];
addEventListener("beforeprint", () => {
  folded = [...document.querySelectorAll("details:not([open])")];
  folded.forEach((entry) => { entry.open = true; });
});
addEventListener("afterprint", () => folded.forEach((entry) => { entry.open = false; }));
