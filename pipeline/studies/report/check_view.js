
// -- drawing ---------------------------------------------------------------------------------------

const pictureOf = (photo) => {
  const [w, h] = [photo.width, photo.height];
  const boxes = [...photo.crowns, ...photo.removed.filter(({ outline }) => outline.length)]
    .map((crown) => extent(crown.outline));
  const low = [0, 1].map((axis) => Math.min(...boxes.map((box) => box[axis])));
  const high = [0, 1].map((axis) => Math.max(...boxes.map((box) => box[axis + 2])));
  const margin = 0.12 * Math.max(high[0] - low[0], high[1] - low[1]);
  const [x, y] = [Math.max(0, low[0] - margin), Math.max(0, low[1] - margin)];
  const near = [x, y, Math.min(w, high[0] + margin) - x, Math.min(h, high[1] + margin) - y];
  return { whole: [0, 0, w, h], near, worth: near[2] * near[3] < 0.75 * w * h };
};

// One card per photograph; its picture stays, its crowns are drawn anew.
const cards = new Map();
const cardOf = (photo) => {
  if (cards.has(photo)) return cards.get(photo);
  const { whole, near, worth } = pictureOf(photo);
  const card = { crowns: make("g"), rows: make("div", { class: "rows" }),
    notes: make("div", { class: "notes" }), mirrored: photo.mirrored };
  card.svg = make("svg", { viewBox: (worth ? near : whole).join(" "), "aria-hidden": "true" },
    card.image = make("image", { href: photo.picture, width: photo.width, height: photo.height }),
    card.crowns);
  const point = (event) => {
    const at = new DOMPoint(event.clientX, event.clientY)
      .matrixTransform(card.svg.getScreenCTM().inverse());
    return [at.x, at.y];
  };
  let dragged = false; // the click that ends a drag chooses nothing
  card.svg.addEventListener("pointerdown", (event) => {
    dragged = false;
    if (!cut || chosen.photo !== photo) return;
    event.preventDefault();
    cut = { ...cut, from: point(event), to: point(event), dragged: true };
    card.svg.setPointerCapture?.(event.pointerId);
  });
  card.svg.addEventListener("pointermove", (event) => {
    if (!cut?.dragged || chosen.photo !== photo) return;
    cut.to = point(event);
    drawCrowns(photo, card);
  });
  card.svg.addEventListener("pointerup", (event) => {
    if (!cut?.dragged || chosen.photo !== photo) return;
    cut.to = point(event);
    cut.dragged = false;
    dragged = true;
    finishCut();
  });
  card.svg.addEventListener("pointercancel", () => {
    if (cut) cut.dragged = false;
  });
  card.svg.addEventListener("click", (event) => {
    if (cut || dragged) return;
    const hit = event.target.closest(".crown");
    choose(photo, hit ? Number(hit.dataset.id) : null);
  });
  const kinds = Object.entries(KIND_NAMES);
  card.kind = make("select", { onchange: () => change(() => {
    photo.kindSaid = card.kind.value === photo.kind && !photo.earlier.kind ? null : card.kind.value;
  }) }, ...(photo.kind in KIND_NAMES ? [] : [make("option", { value: "", disabled: true },
    photo.kind)]), ...kinds.map(([kind, name]) => make("option", { value: kind }, name)));
  const zoom = make("button", { type: "button", class: "plain", onclick: () => {
    const wide = card.svg.getAttribute("viewBox") !== whole.join(" ");
    card.svg.setAttribute("viewBox", (wide ? whole : pictureOf(photo).near).join(" "));
    zoom.textContent = wide ? "Teeth only" : "Whole photograph";
  } }, "Whole photograph");
  card.root = make("article", { "aria-label": photo.name },
    make("div", { class: "head" }, make("h2", {}, photo.name), worth ? zoom : null,
      make("label", {}, "shows the teeth ", card.kind),
      card.sure = make("button", { type: "button", onclick: () => confirm(photo),
        title: "Take every number in this photograph as certain" }, "All numbers are right"),
      card.over = make("button", { type: "button", onclick: () => turnOver(photo),
        title: "Take it as a mirror image, or as none" }, "Mirror image"),
      make("button", { type: "button", onclick: () => useIt(photo, false) }, "Leave out")),
    make("div", { class: "picture" }, card.svg), card.notes, card.rows);
  cards.set(photo, card);
  return card;
};
const useIt = (photo, use) => {
  change(() => {
    photo.use = use === !photo.aside && photo.earlier.use !== true ? null : use;
    if (chosen?.photo === photo) chosen = null;
  });
  say(`${photo.name} is ${use ? "used" : "left out"}.`);
};

const marks = (photo, crown, wrong) => [`q${quadrantOf(crown.number)}`,
  isUnsure(crown, data.doubtful) ? "unsure" : "", wrong.has(crown.id) ? "wrong" : "",
  chosen?.id === crown.id ? "chosen" : ""].join(" ");
const label = (crown) => (crown.number
  ? `${crown.number}${crown.doubt >= data.doubtful ? "?" : ""}` : "?");
// What a removed crown was: its number, or what it looks like.
const goneLabel = (crown) => (crown.number || !crown.offered.length ? label(crown)
  : `${crown.offered[0][0]}?`);
const goneDescribed = (crown) => {
  const tooth = crown.number || crown.offered[0]?.[0];
  const what = !crown.outline.length ? "nothing is read there any more" : !tooth ? `${crown.jaw} crown`
    : `${crown.number ? "" : "looks like "}${nameOf(tooth)}`;
  return `${goneLabel(crown)} bring back: removed, ${what}`;
};
const removedRow = (photo) => {
  const button = (crown) => {
    const point = ({ type }) => cards.get(photo)?.crowns.querySelector(`[data-id="${crown.id}"]`)
      ?.classList.toggle("pointed", ["focus", "pointerenter"].includes(type));
    return make("button", { type: "button", class: "chip q0 gone", "aria-label": goneDescribed(crown),
      onfocus: point, onblur: point, onpointerenter: point, onpointerleave: point,
      onclick: () => bringBack(photo, crown) }, make("s", {}, goneLabel(crown)), " bring back");
  };
  return photo.removed.length ? make("div", {}, make("span", { class: "what" }, "no tooth"),
    make("div", { class: "chips", role: "group", "aria-label": "removed" },
      ...photo.removed.map(button))) : null;
};
const lostRow = (photo) => {
  const button = (entry) => {
    const what = entry.tooth ? String(entry.tooth) : "split";
    return make("button", { type: "button", class: "chip q0 gone",
      "aria-label": `${what} take back: said before, nothing is read there any more`,
      onclick: () => takeBackLost(photo, entry) }, make("s", {}, what), " take back");
  };
  const lost = lostEntries(photo);
  return lost.length ? make("div", {}, make("span", { class: "what" }, "lost"),
    make("div", { class: "chips", role: "group", "aria-label": "said of what is not read any more" },
      ...lost.map(button))) : null;
};
const drawCrowns = (photo, card) => {
  const wrong = new Set(problemsOf(photo).flatMap((problem) => problem.crowns));
  const shown = [...photo.crowns].sort((a, b) => (a.id === chosen?.id) - (b.id === chosen?.id));
  const mean = photo.crowns.reduce((sum, crown) => sum + Math.sqrt(areaOf(crown.outline)), 0)
    / Math.max(1, photo.crowns.length);
  const drawn = (crown, kind, text) => {
    const [x, y] = innerPoint(crown.outline);
    const area = areaOf(crown.outline);
    const size = Math.min(0.36 * (mean || Math.sqrt(area)), 0.46 * Math.sqrt(area));
    return make("g", { class: kind, "data-id": crown.id },
      make("polygon", { points: crown.outline.map((at) => at.join(",")).join(" ") }),
      make("text", { x, y, "font-size": size }, text));
  };
  card.crowns.replaceChildren(
    ...photo.removed.filter(({ outline }) => outline.length)
      .map((crown) => drawn(crown, "gone", goneLabel(crown))),
    ...shown.map((crown) => drawn(crown, `crown ${marks(photo, crown, wrong)}`, label(crown))));
  if (cut && chosen.photo === photo) {
    const [[x1, y1], [x2, y2]] = [cut.from, cut.to];
    card.crowns.append(make("line", { class: "cut", x1, y1, x2, y2 }));
  }
};
const described = (crown, k, row) => `${crown.jaw} row, ${k + 1} of ${row.length}: `
  + (crown.number ? `${crown.number}, ${nameOf(crown.number)}` : "no number")
  + (isUnsure(crown, data.doubtful) && crown.number ? ", doubtful" : "");
const drawCard = (photo) => {
  const card = cardOf(photo);
  const problems = problemsOf(photo);
  const wrong = new Set(problems.flatMap((problem) => problem.crowns));
  card.root.classList.toggle("cutting", cut !== null && chosen.photo === photo);
  card.sure.disabled = problems.some(({ possible }) => !possible)
    || !photo.crowns.some((crown) => crown.number && crown.doubt);
  card.kind.value = kindOf(photo) in KIND_NAMES ? kindOf(photo) : "";
  card.image.setAttribute("transform", photo.mirrored ? `translate(${photo.width} 0) scale(-1 1)` : "");
  if (card.mirrored !== photo.mirrored) {
    const [x, y, wide, high] = card.svg.getAttribute("viewBox").split(" ").map(Number);
    card.svg.setAttribute("viewBox", [photo.width - x - wide, y, wide, high].join(" "));
    card.mirrored = photo.mirrored;
  }
  card.over.setAttribute("aria-pressed", String(photo.mirrored));
  drawCrowns(photo, card);
  card.notes.replaceChildren(
    ...(photo.mirrored ? [make("p", {}, "A mirror image: shown turned over.")] : []),
    ...problems.map(({ text, possible }) => make("p", { class: "wrong" },
      `${possible ? "" : "Can't be: "}${text}.`)));
  const first = photo.crowns.some((crown) => crown.id === chosen?.id) ? null
    : [...rowOf(photo, "upper"), ...rowOf(photo, "lower")][0];
  const rows = ["upper", "lower"].map((jaw) => {
    const row = rowOf(photo, jaw);
    return make("div", {}, make("span", { class: "what" }, jaw),
      make("div", { class: "chips", role: "group", "aria-label": `${jaw} row, left to right` },
        ...row.map((crown, k) => make("button", {
          type: "button", class: `chip ${marks(photo, crown, wrong)}`, "data-id": crown.id,
          "aria-pressed": String(chosen?.id === crown.id), "aria-label": described(crown, k, row),
          tabindex: chosen?.id === crown.id || first === crown ? 0 : -1,
          onclick: () => choose(photo, crown.id),
        }, label(crown)))));
  });
  card.rows.replaceChildren(...[...rows, removedRow(photo), lostRow(photo)].filter(Boolean));
};

const drawRest = (panel) => {
  const used = photos.filter(isUsed);
  const open = used.flatMap((photo) => [
    ...problemsOf(photo).map(({ text, crowns }) => [photo, text, crowns[0]]),
    ...photo.crowns.filter((crown) => isUnsure(crown, data.doubtful)).map((crown) => [photo,
      crown.number ? `${crown.number} is doubtful (${Math.round(100 * crown.doubt)} %)`
        : "a crown without number", crown.id]),
  ]);
  const most = 12;
  panel.replaceChildren(
    make("h2", {}, open.length ? `To look at: ${open.length}` : "Nothing looks wrong"),
    open.length ? make("ul", { class: "open" }, ...open.slice(0, most).map(([photo, text, id]) =>
      make("li", {}, make("button", { type: "button", class: "plain", onclick: () => {
        choose(photo, id ?? null);
        cardOf(photo).root.scrollIntoView({ block: "nearest" });
        uncover();
      } }, make("b", {}, photo.name), ` ${text}`))), open.length > most ? make("li", {}, "and more") : null)
      : make("p", { class: "soft" }, "Compare the numbers with the photographs all the same."),
    make("h3", {}, "Keys"),
    make("ul", { class: "keys" }, ...[["click or Tab", "choose a crown"], ["← → ↑ ↓", "next crown"],
      ["1 6", "its number"], ["Del", "is no tooth"], ["S", "split"],
      ["T", "take back what was said of it"], ["Ctrl Z", "undo"],
      ["Esc", "back"]].map(([keys, text]) =>
      make("li", {}, ...keys.split(" ").flatMap((key) => [/^(or|click)$/.test(key) ? key
        : make("kbd", {}, key), " "]), text))));
};
const drawChosen = (panel, photo, crown) => {
  const row = rowOf(photo, crown.jaw);
  const at = row.indexOf(crown);
  const taken = new Set(photo.crowns.map((other) => other.number));
  const number = (tooth, ...more) => make("button", { type: "button",
    class: `q${quadrantOf(tooth)} ${["", "c1", "c4"][{ 61: 1, 71: 1, 55: 2, 85: 2 }[tooth] ?? 0]} ${tooth === crown.number ? "on" : taken.has(tooth) ? "taken" : ""}`,
    title: nameOf(tooth), "aria-label": `${tooth}, ${nameOf(tooth)}`,
    onclick: () => setNumber(tooth) }, String(tooth), ...more);
  const input = make("input", { inputmode: "numeric", maxlength: 2, size: 2, autocomplete: "off",
    "aria-label": "FDI number", value: crown.number || "", oninput: () => {
      if (/^\d\d$/.test(input.value)) setNumber(Number(input.value));
    }, onkeydown: (event) => {
      if (event.key === "Escape") choose(photo, null);
    } });
  const state = crown.said ? "as you said" : !crown.number ? "no number yet"
    : crown.doubt === 0 ? "as said before" : `doubt ${Math.round(100 * crown.doubt)} %`;
  const chart = (jaw) => [1, -1].flatMap((primary) => (primary < 0 ? [make("span", { class: "gap" })]
    : []).concat([-1, 1].flatMap((side) => Array.from({ length: primary < 0 ? 5 : 8 }, (_, k) =>
    numberAt(jaw, side * (side < 0 ? (primary < 0 ? 5 : 8) - k : k + 1), primary < 0)))
    .map((entry) => (typeof entry === "number" ? number(entry) : entry))));
  const grid = make("div", { class: "chart" });
  const both = [crown.jaw, crown.jaw === "upper" ? "lower" : "upper"];
  const fill = (jaw) => grid.replaceChildren(...chart(jaw));
  fill(both[0]);
  const other = make("button", { type: "button", class: "plain", onclick: () => {
    both.reverse();
    fill(both[0]);
    other.textContent = `${both[1]} jaw`;
  } }, `${both[1]} jaw`);
  const beside = (entry) => (entry ? make("button", { type: "button",
    class: `chip ${marks(photo, entry, new Set())}`, onclick: () => choose(photo, entry.id) },
  label(entry)) : make("span", {}, "the end"));
  panel.replaceChildren(
    make("div", { class: `now q${quadrantOf(crown.number)}` }, input,
      make("div", {}, crown.number ? nameOf(crown.number) : `${crown.jaw} crown`, make("br"),
        make("small", {}, `${state}${crown.weak ? "; weak outline" : ""}`)),
      make("button", { type: "button", class: "plain close", "aria-label": "Back to the list",
        onclick: () => choose(photo, null) }, "✕")),
    make("div", { class: "between" }, "between", beside(row[at - 1]), "and", beside(row[at + 1])),
    make("h3", { hidden: !crown.offered.length }, "By its looks"),
    make("div", { class: "offers" }, ...crown.offered.map(([tooth, share]) =>
      number(tooth, make("small", {}, `${Math.round(100 * share)} %`)))),
    make("h3", {}, "All numbers ", other), grid,
    make("div", { class: "deeds" },
      make("button", { type: "button", onclick: remove }, "Is no tooth"),
      make("button", { type: "button", onclick: startCut, "aria-pressed": String(cut !== null) },
        cut ? "Draw the line …" : "Split"),
      crown.number && row.length > 1 ? make("button", { type: "button", onclick: numberRow,
        title: "Give its neighbours the numbers that follow, to both ends of the row" },
      "Number the row from here") : null,
      numberSaid(photo, crown) ? make("button", { type: "button",
        onclick: () => takeBackNumber(photo, crown) }, `Take back ${crown.number}`) : null,
      splitSaid(photo, crown) ? make("button", { type: "button",
        onclick: () => takeBackSplit(photo, crown) }, "Take back the split") : null));
};
let shown = null; // what was chosen when the page was last drawn
// In narrow windows the panel lies over the photographs: what is chosen must be seen beside it.
const uncover = () => {
  const panel = find("panel");
  const crown = document.querySelector(".crown.chosen polygon");
  if (!crown || getComputedStyle(panel).position !== "fixed") return;
  scrollBy(0, Math.max(0, crown.getBoundingClientRect().bottom + 12 - panel.getBoundingClientRect().top));
};
new ResizeObserver(([{ target }]) => {
  document.documentElement.style.setProperty("--dock", `${target.offsetHeight}px`);
}).observe(document.querySelector("footer.dock"));
let byKeys = false; // who points sees where; for keys the focus has to be in sight
for (const kind of ["keydown", "pointerdown"]) {
  addEventListener(kind, ({ type }) => { byKeys = type === "keydown"; }, true);
}
const draw = () => {
  const held = (chosen ?? shown) && cardOf((chosen ?? shown).photo).root;
  const before = held?.isConnected ? held.getBoundingClientRect().top : null;
  const active = document.activeElement;
  const atCrown = active === document.body || active.closest(".chip, #panel");
  const writing = active.matches("#panel input");
  const panel = find("panel");
  const used = photos.filter(isUsed);
  const holder = find("photographs");
  const wanted = used.map((photo) => cardOf(photo).root);
  if (wanted.length !== holder.children.length || wanted.some((root, k) => root !== holder.children[k])) {
    holder.replaceChildren(...wanted);
  }
  used.forEach(drawCard);
  const crown = chosenCrown();
  panel.classList.toggle("rest", !crown);
  if (crown) drawChosen(panel, chosen.photo, crown);
  else drawRest(panel);
  const left = photos.filter((photo) => !isUsed(photo));
  find("aside").hidden = !left.length;
  find("aside").querySelector(".small").replaceChildren(...left.map((photo) => make("figure", {},
    make("img", { src: photo.picture, alt: `Photograph ${photo.name}, left out.` }),
    make("figcaption", {}, make("b", {}, photo.name), make("br"), photo.aside || "left out by you"),
    photo.crowns.length ? make("button", { type: "button", onclick: () => useIt(photo, true) },
      "Use it") : removedRow(photo), lostRow(photo))));
  find("undo").setAttribute("aria-disabled", String(!past.length));
  if (before !== null && held.isConnected) scrollBy(0, held.getBoundingClientRect().top - before);
  uncover();
  // Where the focus was on the crown, it is on its chip; else it stays where it was. What has gone
  // or can't be pressed any more leaves it to what takes that back.
  const near = atCrown && (chosen ?? shown);
  shown = chosen;
  const wish = crown && writing ? panel.querySelector("input")
    : near ? cardOf(near.photo).rows.querySelector(`[data-id="${near.id}"]`) : active;
  (wish?.isConnected && !wish.disabled ? wish : find("undo")).focus({ preventScroll: !byKeys });
  const again = savedOnce && yamlOf(photos) === saved;
  find("save").textContent = `Save ${data.file}${again ? " again" : ""}`;
};

// -- saving ----------------------------------------------------------------------------------------

// The folder of this page; "" where it isn't on this machine, or has a name that can't be written here.
const folder = () => {
  if (location.protocol !== "file:") return "";
  try {
    const path = decodeURIComponent(location.pathname).replace(/\/[^/]*$/, "");
    return path.replace(/^\/([A-Za-z]:)/, "$1") || "/";
  } catch { // bytes that are no UTF-8
    return "";
  }
};
const save = async () => {
  const text = yamlOf(photos);
  let how = "";
  if (window.showSaveFilePicker) {
    try {
      const file = await window.showSaveFilePicker({ suggestedName: data.file,
        types: [{ description: "YAML", accept: { "text/yaml": [".yaml"] } }] });
      const stream = await file.createWritable();
      await stream.write(text);
      await stream.close();
      how = "saved";
    } catch (error) {
      if (error.name === "AbortError") return;
    }
  }
  if (!how) {
    const link = make("a", { download: data.file,
      href: URL.createObjectURL(new Blob([text], { type: "text/yaml" })) });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    how = "downloaded";
  }
  [saved, savedOnce] = [text, true];
  find("back").querySelector("span")?.remove(); // that they are not saved yet
  remember();
  const place = folder();
  const written = /^[\w./+:-]+$/.test(place) ? place : `'${place.replaceAll("'", "'\\''")}'`;
  const command = [data.command[0], place ? written : "WORKSPACE", data.command[1]].join(" ").trim();
  const copy = make("button", { type: "button", onclick: async () => {
    try {
      await navigator.clipboard.writeText(command);
      copy.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(find("next").querySelector("pre"));
      copy.textContent = "Not allowed: copy what is marked";
    }
  } }, "Copy");
  find("next").replaceChildren(
    make("button", { type: "button", onclick: () => {
      find("next").hidden = true;
      find("save").focus();
    } }, "Close"),
    make("b", {}, `${data.file} is ${how}. Two steps to go:`),
    make("ol", {},
      make("li", {}, data.target ? `Put it in the place of ${data.target}`
        : "Put it into the workspace folder, beside this page",
      !data.target && place ? make("span", {}, ": ", make("code", {}, place)) : "",
      how === "saved" ? ", unless you saved it there." : `. A second download may be called `
        + `otherwise: it has to be ${data.target ? "that file" : data.file}.`),
      make("li", {}, ...(data.batch
        ? ["Run the same pipeline batch again: of its finished cases it does this one anew."]
        : ["Run the same command again, or this one: ", make("pre", {}, command), " ", copy]))),
    make("details", {}, make("summary", {}, `What ${data.file} says`), make("pre", {}, text)));
  find("next").hidden = false;
  say("");
  draw();
};
find("undo").addEventListener("click", undo);
find("save").addEventListener("click", save);
addEventListener("beforeunload", (event) => {
  if (yamlOf(photos) !== saved) event.preventDefault();
});
draw();
window.check = { photos, yaml: () => yamlOf(photos) };
