// The panel with the tools: shows the state, and changes it.

/** Are these the same marks, but for what is written in their notes? */
function onlyTexts(now, before) {
  return now.length === before?.length && now.every((mark, index) =>
    Object.keys(mark).every((key) => key === "text" || mark[key] === before[index][key]));
}

/** List the marks; where only notes were written, what has the focus or is being clicked stays. */
function listMarks(tools, now, before) {
  if (onlyTexts(now.marks, before?.marks)) {
    const notes = now.marks.filter(({ kind }) => kind === "note");
    byId("marks").querySelectorAll("input").forEach((field, k) => { field.value = notes[k].text; });
    return;
  }
  const { scene } = tools.viewer;
  const items = now.marks.map((mark, index) => {
    const item = document.createElement("li");
    const name = { distance: "Distance", angle: "Angle", note: "Note" }[mark.kind];
    if (mark.kind === "note") {
      const field = document.createElement("input");
      field.type = "text";
      field.maxLength = LONGEST_NOTE;
      field.value = mark.text;
      field.placeholder = "Write the note";
      field.setAttribute("aria-label", `Note ${index + 1}`);
      field.addEventListener("change", () => tools.setNote(index, field.value));
      field.addEventListener("keydown", (event) =>  // Enter may also choose among signs to write
        event.key === "Enter" && !event.isComposing && field.blur());
      item.append(field);
    } else {
      const text = document.createElement("span");
      const warning = markWarning(mark, scene.knows);
      text.textContent = `${name} ${markText(mark, scene.scale)}`;
      item.append(text);
      if (warning) {
        const small = document.createElement("small");
        small.textContent = warning;
        text.append(document.createElement("br"), small);
      }
    }
    const remove = document.createElement("button");
    remove.textContent = "×";
    remove.setAttribute("aria-label", `Remove ${name.toLowerCase()} ${index + 1}`);
    remove.addEventListener("click", () => {
      tools.remove(index);
      (byId("marks").querySelector("button") ?? byId("distance")).focus();
    });
    item.append(remove);
    return item;
  });
  byId("marks").replaceChildren(...items);
  byId("marks").hidden = !items.length;
}

/** One row of the table of what is measured by itself. */
function measurementRow(tools, entry) {
  const { scene } = tools.viewer;
  const row = document.createElement("tr");
  const name = document.createElement("th");
  name.scope = "row";
  const value = document.createElement("td");
  if (entry.value === null) {
    name.textContent = entry.title;
    value.textContent = `not visible: ${entry.not_visible}`;
    value.className = "missing";
  } else {
    const show = document.createElement("button");
    show.textContent = entry.title;
    show.title = entry.method;
    show.dataset.measure = entry.name;
    show.setAttribute("aria-pressed", false);
    show.addEventListener("click", () => tools.show(
      { measure: tools.store.now.measure === entry.name ? null : entry.name }));
    name.append(show);
    const text = document.createElement("span");
    text.textContent = measuredText(entry, scene.scale);
    const small = document.createElement("small");
    small.textContent = [estimateText(entry), entry.direction, entry.sure]
      .filter(Boolean).join("; ");
    small.dataset.sure = entry.sure;
    value.append(text, document.createElement("br"), small);
  }
  row.append(name, value);
  return row;
}

function addPanel(viewer, tools) {
  const { scene, store } = viewer;
  for (const tool of CHOICES.tool.slice(1)) {
    byId(tool).addEventListener("click", () => tools.choose(tool));
  }
  for (const key of ["numbers", "jaw", "axis"]) {
    byId(key).addEventListener("change", (event) => tools.show({ [key]: event.target.value }));
  }
  for (const key of ["support", "mesh", "sides"]) {
    byId(key).addEventListener("change", (event) => tools.show({ [key]: event.target.checked }));
  }
  byId("at").addEventListener("input", (event) => tools.show({ at: event.target.value / 100 }));
  byId("copy").addEventListener("click", () => tools.copyLink());
  byId("more").addEventListener("click", () => tools.open(byId("tools").hidden));
  byId("done").addEventListener("click", () => tools.open(false));
  for (const key of ["numbers", "jaw", "support", "mesh"]) {
    byId(key).closest("label").hidden = !tools.has(key);
  }
  byId("automatic").hidden = !scene.measurements.length;
  byId("measured").append(...scene.measurements.map((entry) => measurementRow(tools, entry)));
  byId("scale").textContent = scene.scale.text;

  const update = (now, before) => {
    for (const tool of CHOICES.tool.slice(1)) {
      byId(tool).setAttribute("aria-pressed", now.tool === tool);
    }
    for (const key of ["numbers", "jaw", "axis"]) byId(key).value = now[key];
    for (const key of ["support", "mesh", "sides"]) byId(key).checked = now[key];
    byId("legend").hidden = !now.support;
    byId("opacity").disabled = now.sides;  // there is no photograph of two panes
    document.body.classList.toggle("two-panes", now.sides);
    byId("at").value = Math.round(100 * now.at);
    byId("at").closest("label").hidden = now.axis === "off";
    for (const button of byId("measured").querySelectorAll("button")) {
      button.setAttribute("aria-pressed", button.dataset.measure === now.measure);
    }
    viewer.canvas.classList.toggle("aiming", now.tool !== "turn");
    if (now.marks !== before?.marks) listMarks(tools, now, before);
  };
  store.listeners.push(update);
  update(store.now);
}
