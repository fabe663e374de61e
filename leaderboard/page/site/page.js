"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
const pairs = new Map(data.pairs.map((pair) => [pair.key, pair]));
const state = { track: null, board: 0, sort: {}, shown: null, axes: {}, defense: "", victim: "", attack: "", row: null, pair: null };

/* ---- elements: text goes in as text, never as markup ---- */
function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    // The page's policy refuses the attribute, which text from strangers could end up in.
    else if (name === "style") made.style.cssText = value;
    else if (value !== false && value != null) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child != null));
  return made;
}
/* Text with `names` in it: these are set apart. */
const marked = (text) => text.split("`").map((part, i) => (i % 2 ? el("samp", {}, part) : part));
const fixed = (value, digits = 2) => (value == null ? "—" : (Math.abs(value) < 0.5 * 10 ** -digits ? 0 : value).toFixed(digits).replace("-", "−"));
const short = (value) => fixed(value).replace(/^(−?)0\./, "$1.");
const bounds = (found) => (found && found.low != null ? `${short(found.low)}–${short(found.high)}` : "");
const signed = (found) => (found == null ? "—" : (found.estimate > 0 ? "+" : "") + fixed(found.estimate));
const counted = (cells) => `${cells} cell${cells === 1 ? "" : "s"}`;
const percent = (share) => (share == null ? "—" : `${Math.round(100 * share)} %`);
function estimate(found) {
  return found == null ? ["—"] : [el("b", {}, fixed(found.estimate)), " ", el("small", {}, bounds(found))];
}

/* ---- scores of the selected cells. Intervals are those of the document: they are computed in one place, bench/statistics ---- */
const average = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
/* Of all cells, of one cell, or of all cells with one value of an axis; the mean of other cells has no interval. */
function overCells(one, left, whole) {
  if (!left.length) return null;
  if (left.length === one.cells.length) return whole;
  if (left.length === 1) return left[0];
  const part = one.parts.find(({ axis, value }) => {
    const own = one.cells.filter(({ cell }) => cell[axis] === value);
    return own.length === left.length && own.every((cell) => left.includes(cell));
  });
  return part ?? { estimate: average(left.map((cell) => cell.estimate)), low: null, high: null };
}
function kept(cells) {
  return cells.filter(({ cell }) => Object.entries(state.axes).every(([axis, values]) => values.has(cell[axis])));
}
const over = (one, whole) => overCells(one, kept(one.cells), whole);
function mean(one, name, whole) {
  const left = kept(one.cells);
  return left.length === one.cells.length ? whole : average(left.map((cell) => cell[name]));
}
function ranked(rows) {
  const unranked = (one) => one.row.values.rank == null;
  return [...rows].sort((a, b) => unranked(a) - unranked(b) || a.row.flagged - b.row.flagged || b.score.estimate - a.score.estimate);
}

/* ---- tables: columns say what a row shows, sorts by and copies ---- */
function strip(score, baseline) {
  if (!score) return "";
  const place = (value) => `${(100 * Math.max(0, Math.min(1, value))).toFixed(1)}%`;
  const made = el("span", { class: "strip", "aria-hidden": "true" });
  const bar = el("i"), dot = el("b");
  bar.style.left = place(score.low ?? score.estimate);
  bar.style.right = `calc(100% - ${place(score.high ?? score.estimate)})`;
  dot.style.left = place(score.estimate);
  made.append(bar, dot);
  if (baseline != null) { const line = el("u"); line.style.left = place(baseline); made.append(line); }
  return made;
}
function cardLink(pair, text) {
  return el("a", { href: address({ row: rowOf(pair), pair }) }, text);
}
function draw(id, columns, rows, classes) {
  const table = at(id), sort = state.sort[id];
  const ordered = [...rows];
  if (sort) {
    const column = columns.find((one) => one.name === sort.name);
    const rank = (value) => (value == null ? -Infinity : value);
    if (column) ordered.sort((a, b) => {
      const [x, y] = [rank(column.value(a)), rank(column.value(b))];
      return (x < y ? -1 : x > y ? 1 : 0) * (sort.down ? -1 : 1);
    });
  }
  const focused = document.activeElement?.dataset?.column;
  const shown = columns.filter((column) => !column.hidden);
  const head = el("tr", {}, ...shown.map((column) => {
    const own = sort?.name === column.name ? (sort.down ? "descending" : "ascending") : "none";
    const cell = el("th", { scope: "col", class: column.number ? "number" : null });
    if (column.value) {
      cell.setAttribute("aria-sort", own);
      cell.append(el("button", { type: "button", "data-column": `${id} ${column.name}`, onclick: () => {
        const same = state.sort[id]?.name === column.name;
        state.sort[id] = { name: column.name, down: same ? !state.sort[id].down : Boolean(column.number) };
        render();
      } }, column.name));
    } else cell.append(column.name);
    return cell;
  }));
  const body = ordered.map((row, place) => {
    const grouped = classes?.(row, ordered[place - 1], !sort) ?? "";
    return el("tr", { class: grouped || null }, ...shown.map((column) =>
      el("td", { "data-label": column.name, class: [column.number && "number", column.class].filter(Boolean).join(" ") || null }, ...[column.show(row)].flat().filter((part) => part !== ""))));
  });
  table.replaceChildren(el("thead", {}, head), el("tbody", {}, ...body));
  const told = columns.filter((column) => column.value);
  table.copied = () => ({
    heads: told.map((column) => ({ name: column.name, interval: Boolean(column.interval) })),
    rows: ordered.map((row) => told.map((column) => (column.interval ? { ...(column.interval(row) ?? { estimate: column.value(row) }), best: Boolean(column.best?.(row)) } : column.value(row)))),
  });
  // A phone shows cards without headings to click on.
  const orders = columns.filter((column) => column.value).flatMap(({ name, number }) =>
    (number ? [[`-${name}`, `${name}, highest first`], [name, `${name}, lowest first`]] : [[name, name]]));
  options(at(`sort-${id}`), [["", "default order"], ...orders], sort ? (sort.down ? "-" : "") + sort.name : "");
  if (focused?.startsWith(`${id} `)) table.querySelector(`[data-column="${CSS.escape(focused)}"]`)?.focus();
}
const shortest = (value) => (typeof value === "number" ? Number(value.toFixed(4)).toString() : value == null ? "" : String(value));
/* An interval takes three columns in CSV, and one in LaTeX. */
function csv({ heads, rows }) {
  const lines = [heads.flatMap((head) => (head.interval ? [head.name, `${head.name} low`, `${head.name} high`] : [head.name])),
    ...rows.map((row) => row.flatMap((value, i) => (heads[i].interval ? [value.estimate, value.low, value.high] : [value])))];
  return lines.map((line) => line.map((value) => {
    // A spreadsheet takes these for formulas.
    const text = (typeof value === "string" && /^[=+\-@\t\r]/.test(value) ? "'" : "") + shortest(value);
    return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  }).join(",")).join("\n") + "\n";
}
function latex({ heads, rows }) {
  const escape = (text) => String(text).replace(/[\\&%$#_{}~^]/g, (c) => ({ "\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}" })[c] ?? `\\${c}`).replaceAll("×", "$\\times$").replaceAll("−", "$-$").replaceAll("–", "--");
  const digits = (value) => value.toFixed(Number.isInteger(value) ? 0 : 2);
  const written = (value) => (typeof value === "number" ? escape(digits(value)) : escape(shortest(value)));
  const estimated = ({ estimate, low, high, best }) => {
    if (estimate == null) return "";
    const text = escape(fixed(estimate));
    return (best ? `\\textbf{${text}}` : text) + (low == null ? "" : ` {\\scriptsize [${escape(short(low))}, ${escape(short(high))}]}`);
  };
  const numeric = heads.map((head, i) => head.interval || rows.every((row) => typeof row[i] === "number" || row[i] == null));
  const lines = rows.map((row) => row.map((value, i) => (heads[i].interval ? estimated(value) : written(value))).join(" & ") + " \\\\");
  return ["\\begin{tabular}{" + numeric.map((one) => (one ? "r" : "l")).join("") + "}", "\\toprule", heads.map((head) => escape(head.name)).join(" & ") + " \\\\", "\\midrule", ...lines, "\\bottomrule", "\\end{tabular}"].join("\n") + "\n";
}
async function copy(text, what) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = el("textarea", {}, text);
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  at("said").textContent = `${what} copied`;
  clearTimeout(copy.timer);
  copy.timer = setTimeout(() => { at("said").textContent = ""; }, 2000);
}
for (const place of document.querySelectorAll(".copy")) {
  for (const [name, write] of [["CSV", csv], ["LaTeX", latex]]) {
    place.append(el("button", { type: "button", onclick: () => copy(write(at(place.dataset.table).copied()), name) }, `Copy ${name}`));
  }
}

/* ---- what is shown of a board ---- */
const boards = () => data.boards.filter((board) => board.track === state.track);
const current = () => boards()[state.board];
const said = () => data.tracks[state.track];
const threatText = (t) => `${t.norm} ${t.budget}${t.allowed ? `: ${t.allowed};` : ","} access ${t.access}, ${t.queries} queries${t.share === 1 ? "" : `, ${+(100 * t.share).toPrecision(3)} % of the frames`}`;
const threatName = (t) => threatText({ ...t, allowed: "" });
const threatShort = (t) => (t.budget ? `${t.norm} ${t.budget}, ${t.access}` : "none");
const capital = (text) => text[0].toUpperCase() + text.slice(1);
const place = (cell) => JSON.stringify(Object.entries(cell).sort());
const plural = (count, one) => `${count} ${one}${count === 1 ? "" : "s"}`;
const joined = (values) => values.join(" × ");

function options(select, values, chosen) {
  select.replaceChildren(...values.map(([value, text]) => el("option", { value, selected: String(value) === String(chosen) }, text)));
}
/* ---- addresses: #/TRACK/THREAT/DEFENCE+VICTIM/PAIR?weather=clear&sort=Clean holds all that the page shows ---- */
const written = (text) => encodeURIComponent(text.replaceAll(" ", ",")).replaceAll("%2B", "+").replaceAll("%2C", ",").replaceAll("%3D", "=").replaceAll("%3A", ":");
function boardNames() {
  const taken = new Set();
  return boards().map((board, i) => {
    const t = board.threat;
    let name = "";
    for (const part of [`${t.norm}-${t.budget}`, board.grid, `${t.access}-${t.queries}`, t.share, board.world.name, i]) {
      name = name ? `${name}-${part}` : part;
      if (!taken.has(name)) break;
    }
    taken.add(name);
    return name;
  });
}
const rowName = (row) => `${row.mine ? "yours:" : ""}${row.defense.label}+${row.victim.label}`.replaceAll(" ", ",");
const rowOf = (pair) => current().rows.find((row) => sameDefended(row, pair)) ?? null;
const sorted = (id) => (id === "ranks" ? "sort" : `sort-${id}`);
function address({ row = state.row, pair = state.pair } = {}) {
  const parts = [state.track], query = [];
  const board = current();
  if (board) {
    parts.push(boardNames()[state.board], ...(row ? [rowName(row), ...(pair ? [pair.card.pair] : [])] : []));
    for (const kind of ["defense", "victim", "attack"]) if (state[kind]) query.push([kind, state[kind]]);
    for (const axis of board.axes) {
      const left = axis.values.filter((value) => state.axes[axis.name].has(value));
      if (left.length < axis.values.length) query.push([axis.name, left.join(",")]);
    }
    for (const [id, sort] of Object.entries(state.sort)) query.push([sorted(id), (sort.down ? "-" : "") + sort.name]);
    if (state.shown) query.push(["grid", state.shown[0] === "r" ? rowName(board.rows[+state.shown.slice(1)]) : pairs.get(+state.shown.slice(1)).card.pair]);
  }
  return `#/${parts.map(written).join("/")}${query.length ? `?${query.map(([key, value]) => `${written(key)}=${written(String(value))}`).join("&")}` : ""}`;
}
/* Show what the address says; what it does not say has its default. */
function go() {
  if (location.hash && !location.hash.startsWith("#/")) return;
  const [path, query = ""] = location.hash.slice(2).split("?");
  const read = (text) => { try { return decodeURIComponent(text); } catch { return text; } };
  const [track, boardName, row, pair] = path.split("/").map(read);
  const given = new Map(query.split("&").filter(Boolean).map((part) => part.split(/=(.*)/s).slice(0, 2).map(read)));
  const tracks = [...document.querySelectorAll("[data-track]")].map((button) => button.dataset.track);
  state.track = tracks.includes(track) ? track : tracks[0];
  for (const button of document.querySelectorAll("nav button")) button.setAttribute("aria-pressed", button.dataset.track === state.track);
  at("thesis").hidden = state.track !== "thesis";
  at("method").hidden = state.track !== "method";
  at("board").hidden = !boards().length;
  state.row = state.pair = state.shown = null; state.sort = {};
  if (boards().length) setBoard(Math.max(0, boardNames().map(written).indexOf(written(boardName ?? ""))), given, row, pair);
  showCard();
}
function visit(hash) {
  history.pushState(null, "", hash);
  go();
}
function setBoard(place, given, row, pair) {
  state.board = place;
  const board = current();
  options(at("threat"), boards().map((one, i) => [i, `${one.world.name}, ${one.grid}: ${threatName(one.threat)}`]), place);
  state.axes = Object.fromEntries(board.axes.map((axis) => {
    const wanted = given.has(axis.name) ? given.get(axis.name).split(",") : null;
    return [axis.name, new Set(axis.values.filter((value) => !wanted || wanted.includes(String(value))))];
  }));
  const ordered = [...board.axes].sort((a, b) => b.perceptual - a.perceptual);
  at("axes").replaceChildren(...ordered.map((axis) => el("fieldset", {}, el("legend", { title: axis.meaning }, capital(axis.name) + (axis.unit ? ` (${axis.unit})` : "")),
    ...axis.values.map((value) => el("label", {}, el("input", {
      type: "checkbox", checked: state.axes[axis.name].has(value), name: axis.name, value, onchange: (event) => {
        if (event.target.checked) state.axes[axis.name].add(value); else state.axes[axis.name].delete(value);
        render();
      } }), String(value))))));
  const known = { defense: board.rows.map((one) => one.defense.name), victim: board.rows.map((one) => one.victim.name), attack: within(board).map((one) => one.attack.name) };
  for (const [kind, names] of Object.entries(known)) {
    state[kind] = names.includes(given.get(kind)) ? given.get(kind) : "";
    options(at(kind), [["", "all"], ...[...new Set(names)].sort().map((name) => [name, name])], state[kind]);
  }
  for (const id of ["ranks", "attackers", "pairs"]) {
    const sort = given.get(sorted(id))?.replaceAll(",", " ");
    if (sort) state.sort[id] = { name: sort.replace(/^-/, ""), down: sort.startsWith("-") };
  }
  const findRow = (name) => board.rows.find((one) => written(rowName(one)) === written(name ?? ""));
  const findPair = (name) => within(board).find((one) => written(one.card.pair) === written(name ?? ""));
  const shown = given.get("grid");
  state.shown = findRow(shown) ? `r${board.rows.indexOf(findRow(shown))}` : findPair(shown) ? `p${findPair(shown).key}` : null;
  state.row = findRow(row) ?? null;
  state.pair = state.row ? findPair(pair) ?? null : null;
  render();
}
function within(board) {
  const keys = new Set(board.rows.flatMap((row) => row.pairs));
  return data.pairs.filter((pair) => keys.has(pair.key) || (pair.attack.name === "none" && pair.track === board.track && board.rows.some((row) => sameDefended(row, pair))));
}
function chosen(one) {
  return ["defense", "victim"].every((kind) => !state[kind] || one[kind].name === state[kind]);
}

function render() {
  const board = current();
  if (!board) return;
  const rows = ranked(board.rows.filter(chosen).map((row) => ({ row, score: over(row, row.values.score) })).filter((one) => one.score));
  const baselines = board.baselines.map((baseline) => ({ baseline, score: over(baseline, baseline.score) })).filter((one) => one.score);
  const metric = said().title;
  const total = new Set(board.rows.flatMap((row) => row.cells.map(({ cell }) => place(cell)))).size;
  const left = new Set(board.rows.flatMap((row) => kept(row.cells).map(({ cell }) => place(cell)))).size;
  at("scope").textContent = `${threatText(board.threat)}. ${left} of ${total} cells; ${metric}, mean with its 95 % interval.` + (left === total ? "" : " Ranks and flags refer to all cells.") +
    (rows.some(({ row, score }) => score.low == null && row.values.score.low != null) ? " No interval was computed for these cells together." : "") +
    (rows.some((one) => one.row.flagged) ? " Below the double line, a flag (⚑) casts doubt on each row: it ranks below all rows without one, whatever its score." : "") +
    (rows.some((one) => one.row.values.rank == null)
      ? " A row without a rank has one patch, or its victim sees nothing without an attack."
      : "") +
    " Rows of one rank are not told apart from its first." +
    (rows.length ? "" : " No row was driven in the selected cells.");

  const columns = board.columns.filter(({ shown }) => shown).flatMap((column) => {
    const made = rankColumn(column);
    if (column.name === "score") return [made, { name: "0 – 1", class: "drawn", show: (one) => strip(one.score, baselineOf(one)) }];
    // The cell is named where its score is, and in what is copied.
    if (column.name === "worst_cell") return [{ ...made, hidden: true }];
    if (column.name === "flags" && board.rows.some((row) => row.clip)) return [FILM, made];
    return [made];
  });
  draw("ranks", columns, [...rows, ...baselines], (one, before, unsorted) =>
    [one.baseline ? "baseline" : "", one.row?.mine ? "mine" : "", one.row?.flagged ? "flagged" : "", rankOf(one) === 1 ? "best" : "", unsorted && before && rankOf(one) !== rankOf(before) ? "group" : "", unsorted && before?.row && one.row && one.row.flagged !== before.row.flagged ? "divided" : ""].filter(Boolean).join(" "));

  drawAttackers(board);
  drawWorlds(board);
  drawPairs(board, metric);
  drawMatrix(board);
  drawCurves(board);
  drawHeat(board);
  history.replaceState(null, "", address());
}
/* ---- the ranking: which columns there are, the document says (leaderboard/ranking/columns.py) ---- */
const rankOf = (one) => one.row?.values.rank;
const FILM = { name: "Film", show: ({ row }) => (row?.clip ? el("a", { href: address({ row, pair: null }), "aria-label": `Film of ${row.defense.label} · ${row.victim.label}` }, "▶") : "") };
const LOOKS = {
  defense: (row, text) => [el("a", { href: address({ row, pair: null }) }, text), row.mine ? el("small", { class: "yours" }, " ▸ yours") : ""],
  worst_cell_score: (row, found) => (found == null ? "—" : el("span", { title: `in ${valueOf({ name: "worst_cell" }, row)}` }, fixed(found.estimate))),
  lead: (row, found) => (found == null ? "—" : el("span", { title: `${fixed(found.estimate)} [${bounds(found)}]` }, el("b", {}, signed(found)))),
  strongest_attack: (row, text) => { const one = pairs.get(row.strongest), link = cardLink(one, one.attack.name); link.title = text; return link; },
  flags: (row) => doubts(row),
};
function rankColumn(column) {
  const { name, kind, interval: ends } = column;
  const found = (one) => (one.row ? valueOf(column, one.row) : name === "defense" ? one.baseline.name : name === "score" ? one.score : null);
  return {
    name: column.title,
    class: { defense: "name", strongest_attack: "name", flags: "doubts" }[name],
    number: kind !== "text" && name !== "rank",
    show: (one) => (one.row && LOOKS[name] ? LOOKS[name](one.row, found(one)) : one.row || found(one) ? shown(column, found(one), name === "score") : ""),
    value: (one) => (ends ? found(one)?.estimate ?? null : found(one)),
    ...(ends ? { interval: found } : {}),
    ...(name === "score" ? { best: (one) => rankOf(one) === 1 } : {}),
  };
}
/* What a row has in a column, of the selected cells where the column has a value for each. */
function valueOf(column, row) {
  const found = row.values[column.name], left = kept(row.cells);
  if (left.length === row.cells.length) return found;
  if (column.name === "score") return over(row, found);
  if (column.name === "worst_cell_score") return lowest(left);
  if (column.name === "worst_cell") return joined(Object.values(lowest(left).cell));
  if (!column.by_cell) return found;
  const known = left.map((cell) => cell.values[column.name]).filter((value) => value != null);
  return known.length ? { estimate: average(known), low: null, high: null } : null;
}
const lowest = (cells) => cells.reduce((least, cell) => (cell.estimate < least.estimate ? cell : least));
function shown({ kind, digits, interval }, found, bounded) {
  if (kind === "text") return found ?? "";
  if (found == null) return "—";
  const value = interval ? found.estimate : found;
  if (kind === "difference") return [el("b", {}, signed(found)), " ", el("small", {}, found.low == null ? "" : `${fixed(found.low)} … ${fixed(found.high)}`)];
  const written = kind === "share" ? percent(value) : fixed(value, digits);
  return bounded && interval ? [el("b", {}, written), " ", el("small", {}, bounds(found))] : written;
}
function sameDefended(a, b) {
  return a.mine === b.mine && ["defense", "victim"].every((kind) => JSON.stringify([a[kind].name, a[kind].params]) === JSON.stringify([b[kind].name, b[kind].params]));
}
function controlOf(row) {
  const strongest = pairs.get(row.strongest);
  return data.pairs.find((pair) => pair.attack.name === "none" && pair.track === strongest.track && sameDefended(pair, strongest)) ?? null;
}
function besideBaseline(row) {
  return kept(row.cells).filter((cell) => cell.baseline != null);
}
function baselineOf(one) {
  const cells = one.row ? besideBaseline(one.row) : [];
  return cells.length ? average(cells.map((cell) => cell.baseline)) : null;
}
/* What is said of each flag that was measured or not, and the remarks. */
function reasons(row) {
  const fired = [...row.flags].sort((a, b) => (b.fired === true) - (a.fired === true));
  return el("ul", {}, ...fired.map((flag) =>
    el("li", {}, el("b", {}, `${flag.fired ? "⚑ " : ""}${flag.name.replaceAll("_", " ")}: `), ...marked(flag.reason))), ...remarksOf(row));
}
/* A mark with a tip: the titles when the pointer is over it, the measurements when it is pressed. */
function doubts(row) {
  const fired = row.flags.filter((flag) => flag.fired).map((flag) => flag.title);
  const notes = row.remarks.map(remarkName);
  const said = [...fired, ...notes.map((name) => `note: ${name}`)].join("; ") || `none of ${row.flags.filter((flag) => flag.fired != null).length} flags`;
  const mark = [fired.length ? `⚑ ${fired.length}` : "", notes.length ? `⚠ ${notes.length}` : ""].filter(Boolean).join(" ") || "–";
  return tip(mark, `${plural(fired.length, "flag")}, ${plural(notes.length, "note")}: ${said}`, said, reasons(row), fired.length ? "" : "quiet");
}
function tip(mark, label, title, content, classes) {
  const panel = el("div", { popover: "auto", class: "tip", role: "dialog", tabindex: "0", "aria-label": label }, content);
  const button = el("button", { type: "button", class: `mark ${classes}`.trim(), title, "aria-label": label, "aria-haspopup": "dialog", onclick: () => {
    panel.togglePopover();
    const at = button.getBoundingClientRect(), own = panel.getBoundingClientRect();
    panel.style.left = `${Math.max(8, Math.min(at.right - own.width, innerWidth - own.width - 8))}px`;
    panel.style.top = `${Math.max(8, Math.min(at.bottom + 4, innerHeight - own.height - 8))}px`;
  } }, mark);
  return el("span", {}, button, panel);
}
/* What a reader must know before trusting a number. */
const remarkName = (remark) => remark.name.replaceAll("_", " ");
const remarksOf = (one) => one.remarks.map((remark) => el("li", {}, el("b", {}, `⚠ ${remarkName(remark)}: `), ...marked(remark.text)));
/* By how much an attack lowers the score of its row further than all the others do. */
function added(pair, row) {
  const place = row ? row.pairs.indexOf(pair.key) : -1;
  return place < 0 ? null : row.marginal[place];
}
function adds(pair, row) {
  const found = added(pair, row);
  return found ? [fixed(found.estimate), " ", el("small", {}, found.low == null ? "" : `${fixed(found.low)} … ${fixed(found.high)}`)] : "";
}
/* The attacks of the board, by what they add (leaderboard/ranking/attackers.py); they refer to all cells, as ranks do. */
function drawAttackers(board) {
  const one = (name, key, show) => ({ name, number: true, value: (row) => row[key], show: (row) => show(row[key]) });
  const whole = (value) => fixed(value, 0);
  draw("attackers", [
    { name: "Rank", show: (row) => String(row.rank), value: (row) => row.rank },
    { name: "Attack", show: (row) => [row.name, row.variants > 1 ? el("small", {}, ` ${plural(row.variants, "variant")}`) : ""], value: (row) => row.name },
    one("Adds", "added", (value) => el("b", {}, fixed(value))),
    one("Alone takes", "alone", fixed),
    one("Strongest in cells", "strongest", percent),
    one(`Rows of ${board.rows.length}`, "rows", whole),
    one(capital(said().queries_title), "queries", whole),
    one("CPU s / episode", "seconds", (value) => fixed(value, value < 10 ? 2 : 0)),
  ], board.attackers);
}
/* The same defended victims in several worlds; the ranks and shares are those of the document. */
function worldsOf(board) {
  const near = (one, names) => names.every((name) => one.threat[name] === board.threat[name]);
  const found = data.worlds.filter((one) => one.track === board.track && near(one, ["norm", "budget", "share"]));
  return found.find((one) => near(one, ["access", "queries"])) ?? found[0];
}
function drawWorlds(board) {
  const found = worldsOf(board);
  const first = (text) => text.split(/[ (]/)[0];
  const kept = (row) => ["defense", "victim"].every((kind) => !state[kind] || first(state[kind]) === first(row[kind]));
  const rows = (found?.rows ?? []).filter(kept);
  at("worlds-section").hidden = !rows.length;
  if (!rows.length) return;
  const scale = rows.some((row) => row.rank), names = found.worlds.map(({ name }) => name);
  at("worlds-said").textContent = `${threatName(found.threat)}. ` + (scale
    ? "A share of 0 is the best blind policy of the world, 1 is perfect information; below it is the score. Each row under the attacks that it met in all of its worlds."
    : "The score under the strongest attacks that a row met in all of its worlds.");
  const value = (row, name) => {
    const one = row.worlds[name], share = one?.share ?? null;
    if (!one) return el("td", { class: "value" }, el("small", {}, row.lacks[name] ?? ""));
    const big = scale ? share : one.score.estimate;
    const small = scale ? `score ${short(one.score.estimate)}` : bounds(one.score);
    return el("td", { class: "value", style: big == null ? null : tint(big), title: row.lacks[name] ?? null }, fixed(big), el("small", {}, small));
  };
  const heads = scale ? ["Rank", "Defended victim", "Mean over worlds", "Worst world"] : ["Defended victim"];
  at("worlds").replaceChildren(
    el("thead", {}, el("tr", {}, ...[...heads, ...names].map((name) => el("th", { scope: "col" }, name)))),
    el("tbody", {}, ...rows.map((row) => el("tr", { class: row.mine ? "mine" : null },
      ...(scale ? [el("td", { class: "number" }, row.rank ?? "—")] : []),
      el("th", { scope: "row" }, row.name, row.mine ? el("small", { class: "yours" }, " ▸ yours") : ""),
      ...(scale ? [el("td", { class: "value" }, ...estimate(row.mean)), el("td", { class: "value" }, fixed(row.worst_world?.share ?? null), el("small", {}, row.worst_world?.name ?? ""))] : []),
      ...names.map((name) => value(row, name))))));
  at("worlds-notes").replaceChildren(...found.notes.map((text) => el("li", {}, text)));
  at("worlds").copied = () => ({
    heads: [{ name: "rank" }, { name: "victim" }, { name: "mean over worlds", interval: true }, { name: "worst world" }, ...names.map((name) => ({ name: `share in ${name}` })), ...names.map((name) => ({ name: `score in ${name}`, interval: true }))],
    rows: rows.map((row) => [row.rank, row.name, row.mean ?? { estimate: null }, row.worst_world?.name ?? null, ...names.map((name) => row.worlds[name]?.share ?? null), ...names.map((name) => row.worlds[name]?.score ?? { estimate: null })]),
  });
}
function drawPairs(board, metric) {
  const rows = within(board).filter(chosen).filter((pair) => !state.attack || pair.attack.name === state.attack)
    .map((pair) => ({ pair, score: over(pair, pair.score) })).filter((one) => one.score);
  const failed = ({ pair }) => mean(pair, "failed", pair.measures[said().failure]?.estimate ?? null);
  const queries = ({ pair }) => mean(pair, "queries", pair.queries);
  draw("pairs", [
    { name: "Attack", class: "name", show: ({ pair }) => cardLink(pair, pair.attack.label), value: ({ pair }) => pair.attack.label },
    { name: "Defence", class: "name", show: ({ pair }) => pair.defense.label, value: ({ pair }) => pair.defense.label },
    { name: "Victim", show: ({ pair }) => pair.victim.label, value: ({ pair }) => pair.victim.label },
    { name: "Threat model", show: ({ pair }) => threatShort(pair.threat), value: ({ pair }) => threatShort(pair.threat) },
    { name: capital(metric), show: (one) => [estimate(one.score), el("small", {}, " ", part(one.pair, rowOf(one.pair)))].flat(), value: (one) => one.score.estimate, interval: (one) => one.score, number: true },
    { name: "0 – 1", class: "drawn", show: (one) => strip(one.score) },
    ...(said().failure ? [{ name: capital(said().failure_title), show: (one) => percent(failed(one)), value: failed, number: true }] : []),
    { name: "Asks", show: ({ pair }) => pair.asks, value: ({ pair }) => pair.asks },
    { name: "Queries", show: (one) => fixed(queries(one), 0), value: queries, number: true },
    { name: "Adds", show: ({ pair }) => adds(pair, rowOf(pair)), value: ({ pair }) => added(pair, rowOf(pair))?.estimate ?? null, interval: ({ pair }) => added(pair, rowOf(pair)), number: true },
    ...(rows.some(({ pair }) => pair.remarks.length) ? [{ name: "Doubts", class: "doubts", show: ({ pair }) => (pair.remarks.length ? tip(`⚠ ${pair.remarks.length}`, `${plural(pair.remarks.length, "note")}: ${pair.remarks.map(remarkName).join("; ")}`, pair.remarks.map(remarkName).join("; "), el("ul", {}, ...remarksOf(pair)), "") : ""), value: ({ pair }) => pair.remarks.map(remarkName).join(" ") }] : []),
    { name: "Recording", show: ({ pair }) => (pair.card.recording ? el("a", { href: data.recordings + pair.card.recording }, "rrd") : "") },
  ], rows);
}

/* ---- colour: cividis, safe for colour-blind eyes ---- */
const STOPS = [[0, 34, 78], [66, 78, 108], [125, 124, 120], [188, 175, 111], [254, 232, 56]];
function tint(value) {
  const place = Math.max(0, Math.min(1, value)) * (STOPS.length - 1);
  const low = Math.min(Math.floor(place), STOPS.length - 2);
  const rgb = STOPS[low].map((from, i) => Math.round(from + (STOPS[low + 1][i] - from) * (place - low)));
  // Black or white, whichever can be read better (WCAG 2): at least 4.58 on any colour.
  const [r, g, b] = rgb.map((c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4));
  const level = 0.2126 * r + 0.7152 * g + 0.0722 * b;
  return `background: rgb(${rgb.join(", ")}); color: ${(level + 0.05) ** 2 > 0.05 * 1.05 ? "#000" : "#fff"}`;
}
function drawHeat(board) {
  const choices = board.rows.map((row, i) => [`r${i}`, `${row.defense.label} · ${row.victim.label}: worst attack of each cell`])
    .concat(within(board).map((pair) => [`p${pair.key}`, `${pair.defense.label} · ${pair.victim.label}: ${pair.attack.name === "none" ? "no attack" : `${pair.attack.label}, ${threatShort(pair.threat)}`}`]));
  const known = choices.some(([value]) => value === state.shown) ? state.shown : choices[0][0];
  options(at("shown"), choices, known);
  const shown = known[0] === "r" ? board.rows[+known.slice(1)] : pairs.get(+known.slice(1));
  const cells = kept(shown.cells), [down, across] = split(board.axes);
  const of = (axes) => [...new Map(cells.map(({ cell }) => [joined(axes.map((axis) => cell[axis.name])), cell])).entries()]
    .sort(([, a], [, b]) => axes.reduce((found, axis) => found || axis.values.indexOf(a[axis.name]) - axis.values.indexOf(b[axis.name]), 0));
  const columns = of(across);
  const head = el("tr", {}, el("th", { scope: "col" }, capital(joined(down.map((axis) => axis.name)))), ...columns.map(([name]) => el("th", { scope: "col" }, name || said().title)));
  at("heat").className = "heat";
  at("heat").replaceChildren(el("thead", {}, head), el("tbody", {}, ...of(down).map(([name, row]) => el("tr", {}, el("th", { scope: "row" }, name),
    ...columns.map(([column, values]) => {
      const one = cells.find(({ cell }) => down.every((axis) => cell[axis.name] === row[axis.name]) && across.every((axis) => cell[axis.name] === values[axis.name]));
      if (!one) return el("td", {}, "—");
      const by = one.pair == null ? "" : pairs.get(one.pair).attack.name;
      return el("td", { style: tint(one.estimate), title: `${[name, column].filter(Boolean).join(", ")}: ${fixed(one.estimate)} ${bounds(one)} ${by}` },
        fixed(one.estimate), el("small", {}, [bounds(one), by].filter(Boolean).join(" ")));
    })))));
}
/* The axes that go down the grid, and those that go across: the perceptual ones, or else the last. */
function split(axes) {
  const across = axes.filter((axis) => axis.perceptual), down = axes.filter((axis) => !axis.perceptual);
  if (!down.length) return [across, []];
  return across.length || down.length < 2 ? [down, across] : [down.slice(0, -1), down.slice(-1)];
}
/* Of a pair that was driven in fewer cells than its row. */
function part(pair, row) {
  const own = kept(pair.cells).length, all = row ? kept(row.cells).length : own;
  return own < all ? `${own} of ${all} cells` : "";
}
/* An attack, with its threat model where it is not that of the board. */
function attackName(pair) {
  const t = current().threat, same = ["budget", "access", "queries"].every((name) => pair.threat[name] === t[name]);
  return pair.attack.label + (same ? "" : ` (${threatShort(pair.threat)}, ${pair.threat.queries} queries)`);
}
function drawMatrix(board) {
  const rows = board.rows.filter(chosen);
  const all = within(board).filter(chosen);
  const controls = all.filter((pair) => pair.attack.name === "none");
  const label = (pair) => (pair.attack.name === "none" ? "no attack" : attackName(pair));
  const driven = (attack) => all.reduce((sum, pair) => sum + (label(pair) === attack ? pair.cells.length : 0), 0);
  const attacks = [...new Set([...controls, ...all.filter((pair) => pair.attack.name !== "none")].map(label))]
    .sort((a, b) => (b === "no attack") - (a === "no attack") || driven(b) - driven(a));
  const find = (row, attack) => all.find((pair) => label(pair) === attack && sameDefended(pair, row));
  const scored = rows.map((row) => attacks.map((attack) => { const pair = find(row, attack); return pair && { pair, score: over(pair, pair.score) }; }));
  at("matrix").replaceChildren(
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "Defence · victim"), ...attacks.map((attack) => el("th", { scope: "col" }, attack)))),
    el("tbody", {}, ...rows.map((row, i) => el("tr", {}, el("th", { scope: "row" }, `${row.defense.label} · ${row.victim.label}`),
      ...scored[i].map((one) => (one?.score ? el("td", { class: "value", style: tint(one.score.estimate) }, cardLink(one.pair, fixed(one.score.estimate)), el("small", {}, bounds(one.score)), el("small", {}, part(one.pair, rows[i]))) : el("td", { class: "value" }, "")))))));
  at("matrix").copied = () => ({
    heads: [{ name: "defence" }, { name: "victim" }, ...attacks.map((name) => ({ name, interval: true }))],
    rows: rows.map((row, i) => [row.defense.label, row.victim.label, ...scored[i].map((one) => one?.score ?? { estimate: null })]),
  });
}
/* ---- curves: every defended victim is a line of one plot ---- */
function drawCurves(board) {
  const alike = (one) => one.track === board.track && ["grid", "world"].every((name) => JSON.stringify(one[name]) === JSON.stringify(board[name])) &&
    ["norm", "access", "queries", "share"].every((name) => one.threat[name] === board.threat[name]);
  const family = data.boards.filter(alike).sort((a, b) => a.threat.budget - b.threat.budget);
  const found = board.rows.filter(chosen).map((row) => ({
    row,
    parts: family.flatMap((one) => one.rows.filter((other) => sameDefended(row, other)).map((other) => ({ x: one.threat.budget, of: other }))),
  })).filter(({ parts }) => parts.length > 1);
  // Only cells that every point of every line has: otherwise a line would compare different roads.
  const sets = found.flatMap(({ row, parts }) => [...parts.map(({ of }) => of), controlOf(row)].filter(Boolean).map((one) => new Set(kept(one.cells).map(({ cell }) => place(cell)))));
  const common = new Set([...(sets[0] ?? [])].filter((name) => sets.every((set) => set.has(name))));
  const on = (one) => overCells(one, one.cells.filter(({ cell }) => common.has(place(cell))), one.values?.score ?? one.score);
  const budget = !common.size ? [] : found.map(({ row, parts }) => ({
    name: `${row.defense.label} · ${row.victim.label}`,
    points: [...(controlOf(row) ? [{ x: 0, ...on(controlOf(row)) }] : []), ...parts.map(({ x, of }) => ({ x, ...on(of) }))],
  }));
  const effort = data.curves.filter((curve) => curve.kind === "queries").map((curve) => ({ curve, first: pairs.get(curve.points[0].pair) }))
    .filter(({ first }) => first.track === board.track && chosen(first) && first.threat.norm === board.threat.norm && first.threat.budget === board.threat.budget && rowOf(first))
    .map(({ curve, first }) => ({ name: `${first.attack.label} on ${first.defense.label} · ${first.victim.label} (${counted(curve.cells.length)})`, points: curve.points }));
  const plots = [
    plot(budget, `Budget (${board.threat.norm}); 0 is no attack`, false, `Score under the strongest attack, on the ${counted(common.size)} that every point has`),
    plot(effort, `${capital(said().queries_title)}, log scale`, true, "Score when an attack may ask more"),
  ].filter(Boolean);
  at("curves-section").hidden = !plots.length;
  at("curves").replaceChildren(...plots);
}
/* Round numbers: 1, 2 or 5 times a power of ten. */
function ticks(low, high, log) {
  const found = [];
  if (log) {
    for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) for (const digit of [1, 2, 5]) found.push(digit * 10 ** power);
    const within = found.filter((x) => x >= low && x <= high);
    return within.length > 1 ? within : [found.filter((x) => x < low).pop() ?? low, found.find((x) => x > high) ?? high];
  }
  const rough = (high - low) / 4 || 1, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((digit) => digit * power >= rough) * power;
  for (let n = Math.ceil(low / step); n * step <= high * 1.0001; n++) found.push(+(n * step).toPrecision(6));
  return found;
}
function plot(lines, unit, log, title) {
  const xs = lines.flatMap(({ points }) => points.map(({ x }) => x)).filter((x) => !log || x > 0);
  if (!xs.length) return null;
  const W = 560, H = 280, L = 40, B = 46, T = 10, R = 16, ns = "http://www.w3.org/2000/svg";
  const scale = (x) => (log ? Math.log10(Math.max(x, 1e-9)) : x);
  const marks = ticks(Math.min(...xs), Math.max(...xs), log);
  const low = scale(Math.min(...xs, ...(log ? marks : []))), high = scale(Math.max(...xs, ...(log ? marks : [])));
  const X = (x) => L + ((scale(x) - low) / (high - low || 1)) * (W - L - R), Y = (y) => H - B - Math.max(0, Math.min(1, y)) * (H - B - T);
  const make = (tag, attributes, text) => { const made = document.createElementNS(ns, tag); for (const [k, v] of Object.entries(attributes)) made.setAttribute(k, v); if (text != null) made.textContent = text; return made; };
  const svg = make("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": lines.map(({ name, points }) => `${name}: ${points.map((p) => `${+p.x.toPrecision(3)}: ${fixed(p.estimate)}`).join(", ")}`).join("; ") });
  for (const y of [0, 0.25, 0.5, 0.75, 1]) svg.append(make("path", { class: "axis", d: `M${L} ${Y(y)}H${W - R}` }), make("text", { x: L - 6, y: Y(y) + 4, "text-anchor": "end" }, String(y)));
  for (const x of marks) svg.append(make("path", { class: "axis", d: `M${X(x)} ${H - B}v5` }), make("text", { class: "tick", x: X(x), y: H - B + 18, "text-anchor": "middle" }, String(x)));
  svg.append(make("text", { x: (L + W - R) / 2, y: H - 6, "text-anchor": "middle" }, unit));
  lines.forEach(({ points }, n) => {
    const colour = `c${n % 8}`, dash = n >= 8 ? "4 3" : null;
    for (const p of points) if (p.low != null) svg.append(make("path", { class: `bar ${colour}`, d: `M${X(p.x)} ${Y(p.low)}V${Y(p.high)}` }));
    svg.append(make("path", { class: `line ${colour}`, ...(dash ? { "stroke-dasharray": dash } : {}), d: "M" + points.map((p) => `${X(p.x)} ${Y(p.estimate)}`).join("L") }));
    for (const p of points) svg.append(make("circle", { class: colour, cx: X(p.x), cy: Y(p.estimate), r: 4 }));
  });
  const key = (n) => { const swatch = make("svg", { viewBox: "0 0 28 10", class: "swatch", "aria-hidden": "true" }); swatch.append(make("path", { class: `line c${n % 8}`, ...(n >= 8 ? { "stroke-dasharray": "4 3" } : {}), d: "M0 5H28" }), make("circle", { class: `c${n % 8}`, cx: 14, cy: 5, r: 4 })); return swatch; };
  return el("figure", {}, el("figcaption", {}, title), svg, el("ul", { class: "key" }, ...lines.map(({ name }, n) => el("li", {}, key(n), name))));
}

/* ---- cards: of a row, and of one attack on it ---- */
const fact = (name, ...value) => [el("dt", {}, name), el("dd", {}, ...value)];
const command = (text) => [el("code", {}, text), el("button", { type: "button", onclick: () => copy(text, "Text") }, "Copy")];
const listed = (values) => values.join(", ") || "none";
/* Where this card can be found again. */
function here() {
  return location.protocol === "file:" ? `cavbench leaderboard, ${address()}` : location.href.split("#")[0] + address();
}
function bibtex(title, key) {
  return [`@misc{cavbench-${key.replace(/[^\w.-]+/g, "-")},`, `  title = {${title}},`, "  author = {{The cavbench authors}},", `  year = {${data.made.slice(0, 4)}},`,
    `  note = {cavbench ${data.cavbench}, records of ${data.made.slice(0, 10)}},`, `  howpublished = {${here()}}`, "}"].join("\n");
}
/* What the components are, with the papers that their authors name. */
const FOLDERS = { attack: "attacks", defense: "defenses", victim: "victims", world: "worlds" };
function page(card, kind) {
  const name = card.components[kind].name;
  const own = card.about[kind].includes("Code: cavbench.") && !/[+:]/.test(name);
  return data.docs && own ? el("a", { href: `${data.docs}${FOLDERS[kind]}/${name}.html` }, "documentation") : null;
}
/* A search for the paper that the code names, by its title or by authors, year and what it does: addresses of papers move. */
function paper(text) {
  const title = text.match(/"([^"]{12,})"/)?.[0], authors = text.match(/\(([^()"]*\b(?:19|20)\d\d[^()"]*)/)?.[1];
  const wanted = title ?? (authors ? `${authors} ${text.split("(")[0]}` : null);
  return wanted ? el("a", { href: `https://scholar.google.com/scholar?q=${encodeURIComponent(wanted)}`, rel: "noreferrer" }, "find the paper") : null;
}
function works(card, kinds) {
  return kinds.flatMap((kind) => fact(kind === "defense" ? "defence" : kind,
    el("b", {}, [card.components[kind].name, ...Object.entries(card.components[kind].params).map(([k, v]) => `${k}=${JSON.stringify(v)}`)].join(" ")),
    card.about[kind] ? el("div", {}, ...marked(card.about[kind])) : null,
    el("small", { class: "quiet links" }, page(card, kind), paper(card.about[kind]), listed(card.shipped_by[kind]))));
}
function provenance(pair) {
  const card = pair.card;
  return [
    ...fact("training seeds", listed(card.training_seeds)),
    ...fact("scenario seeds", `${card.scenario_seeds[0]} to ${card.scenario_seeds[1]} (${listed(card.grid)}), ${pair.cells.length} cells, ${card.episodes} episodes` + (card.left_out ? `; ${card.left_out} left out` : "")),
    ...fact("weights (sha256)", listed(card.weights_sha256)),
    ...(card.artefact_sha256.length ? fact(`${data.tracks[pair.track].artefact} (sha256)`, listed(card.artefact_sha256)) : []),
    ...fact("code (sha256)", listed(card.code_digest)),
    ...fact("libraries", ...card.libraries.map((one) => el("div", {}, Object.entries(one).map(([k, v]) => `${k} ${v}`).join(", ")))),
    ...fact("machine", listed(card.machine)),
    ...fact("finished", `${card.finished}, ${card.wall_s} s of work`),
    ...fact("run it again", ...command(card.run)),
    ...fact("replay an episode", ...command(card.replay)),
  ];
}
function rowCard(row) {
  const name = `${row.defense.label} · ${row.victim.label}`, strongest = pairs.get(row.strongest);
  const film = row.clip ? el("figure", { class: "film" }, el("img", { src: row.clip, alt: `The same scenario without an attack, and under ${strongest.attack.name}`, onerror: (event) => event.target.closest("figure").remove() }), el("figcaption", {}, "The same scenario without an attack (above), and attacked (below)")) : null;
  return [name, el("p", { class: "quiet" }, threatText(current().threat)), film, el("dl", {},
    ...current().columns.filter((column) => column.shown && !["defense", "victim", "strongest_attack", "flags"].includes(column.name))
      .flatMap((column) => (row.values[column.name] == null ? [] : fact(column.title, ...[shown(column, row.values[column.name], true)].flat()))),
    ...fact("attacks", ...row.pairs.map((key) => el("div", {}, cardLink(pairs.get(key), attackName(pairs.get(key))), " ", ...estimate(pairs.get(key).score), " ", el("small", { class: "quiet" }, part(pairs.get(key), row))))),
    ...fact("flags", reasons(row)),
    ...works(strongest.card, ["defense", "victim", "world"]),
    ...fact("strongest attack", pairs.get(row.strongest).attack.label),
    ...provenance(strongest),
    ...fact("cite", ...command(bibtex(`${name} under ${threatName(current().threat)}, ${current().grid}: ${data.tracks[state.track].title} ${fixed(row.values.score.estimate)} [${bounds(row.values.score)}]`, rowName(row)))),
    ...fact("address", ...command(here())))];
}
function pairCard(pair) {
  const card = pair.card;
  return [card.pair, null, null, el("dl", {},
    ...fact("score", ...estimate(pair.score)),
    ...(pair.remarks.length ? fact("doubts", el("ul", {}, ...remarksOf(pair))) : []),
    ...works(card, ["attack", "defense", "victim", "world"]),
    ...fact("threat model", pair.threat.budget ? threatName(pair.threat) : "nothing is attacked"),
    ...provenance(pair),
    ...fact("recording", card.recording ? el("a", { href: data.recordings + card.recording }, card.recording) : "none here; the command above makes one"),
    ...fact("cite", ...command(bibtex(`${card.pair}: ${data.tracks[pair.track].title} ${fixed(pair.score.estimate)} [${bounds(pair.score)}]`, card.pair))),
    ...fact("address", ...command(here())))];
}
function showCard() {
  const dialog = at("card");
  if (!state.row) { if (dialog.open) dialog.close(); return; }
  const [title, ...parts] = state.pair ? pairCard(state.pair) : rowCard(state.row);
  dialog.replaceChildren(
    el("div", { class: "bar" }, el("h2", { id: "card-title" }, title), el("button", { type: "button", onclick: () => dialog.close() }, "Close")),
    ...parts.filter(Boolean));
  dialog.scrollTop = 0;
  if (!dialog.open) dialog.showModal();
}
at("card").addEventListener("close", () => { state.row = state.pair = null; history.replaceState(null, "", address()); });
at("card").addEventListener("click", (event) => { if (event.target === at("card")) at("card").close(); });
addEventListener("hashchange", go);
at("links").append(...[[data.docs && `${data.docs}index.html`, "Documentation"], [data.docs && `${data.docs}leaderboard.html`, "How rows are ranked"],
  [data.docs && `${data.docs}submit.html`, "Hand in a row"], [data.repository, "Repository"]].filter(([href]) => href).map(([href, text]) => el("a", { href }, text)));

for (const button of document.querySelectorAll("[data-track]")) button.addEventListener("click", (event) => { event.preventDefault(); visit(`#/${button.dataset.track}`); });
at("threat").addEventListener("change", (event) => visit(`#/${written(state.track)}/${written(boardNames()[+event.target.value])}`));
for (const kind of ["defense", "victim", "attack"]) at(kind).addEventListener("change", (event) => { state[kind] = event.target.value; render(); });
for (const id of ["ranks", "attackers", "pairs"]) at(`sort-${id}`).addEventListener("change", ({ target }) => {
  if (target.value) state.sort[id] = { name: target.value.replace(/^-/, ""), down: target.value.startsWith("-") };
  else delete state.sort[id];
  render();
});
at("shown").addEventListener("change", (event) => { state.shown = event.target.value; render(); });
at("filters").addEventListener("reset", (event) => { event.preventDefault(); visit(`#/${written(state.track)}/${written(boardNames()[state.board])}`); });
at("filters").addEventListener("submit", (event) => event.preventDefault());
go();
