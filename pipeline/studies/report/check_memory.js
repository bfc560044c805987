// What was changed here stays in the browser, for exactly this page's data and place: a page that a
// run writes anew begins clean.

const KEPT = "dentalsplat check 1 ";
const MOST_DAYS = 60;
const opened = { state: stateNow(), yaml: yamlOf(photos) };
// Browsers may refuse to keep anything.
const withStorage = (deed) => {
  try {
    return deed(localStorage);
  } catch {
    return null;
  }
};
const remember = () => withStorage((storage) => {
  storage.removeItem(KEPT + location.pathname);
  if (yamlOf(photos) === opened.yaml) return;
  const state = stateNow().map((fields, k) =>
    (fields.every((value, n) => value === opened.state[k][n]) ? null : fields));
  storage.setItem(KEPT + location.pathname, JSON.stringify(
    { of: data.digest, on: Date.now(), state, nextId, saved: savedOnce ? saved : null }));
});
const discard = () => {
  change(() => {
    takeState(opened.state);
    chosen = null;
  });
  find("back").hidden = true;
  find("undo").focus();
  say("Discarded: this is what the run found.");
};
const recall = () => {
  const kept = withStorage((storage) => {
    for (const key of Object.keys(storage).filter((name) => name.startsWith(KEPT))) {
      if (JSON.parse(storage.getItem(key)).on < Date.now() - MOST_DAYS * 86400e3) storage.removeItem(key);
    }
    return JSON.parse(storage.getItem(KEPT + location.pathname));
  });
  if (kept?.of !== data.digest) return;
  takeState(kept.state.map((fields, k) => fields ?? opened.state[k]));
  ({ nextId } = kept);
  if (kept.saved) [saved, savedOnce] = [kept.saved, true];
  const date = new Date(kept.on).toLocaleString("en-GB", { dateStyle: "long", timeStyle: "short" });
  find("back").replaceChildren(make("p", {}, `Your changes of ${date} are back`,
    yamlOf(photos) === saved ? null : make("span", {}, `, not saved in ${data.file} yet`), ". ",
    make("button", { type: "button", onclick: discard }, "Discard")));
  find("back").hidden = false;
};
recall();
