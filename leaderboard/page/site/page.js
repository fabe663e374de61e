"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
const pairs = new Map(data.pairs.map((pair) => [pair.key, pair]));
const state = { track: null, board: 0, sort: {}, shown: null, axes: {} };

/* ---- elements: text goes in as text, never as markup ---- */
function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== false && value != null) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child != null));
  return made;
}
const fixed = (value, digits = 2) => (value == null ? "—" : (Math.abs(value) < 0.5 * 10 ** -digits ? 0 : value).toFixed(digits).replace("-", "−"));
const short = (value) => fixed(value).replace(/^(−?)0\./, "$1.");
const bounds = (found) => (found && found.low != null ? `${short(found.low)}–${short(found.high)}` : "");
const signed = (found) => (found == null ? "—" : (found.estimate > 0 ? "+" : "") + fixed(found.estimate));
const percent = (share) => (share == null ? "—" : `${Math.round(100 * share)} %`);
function estimate(found) {
  return found == null ? ["—"] : [el("b", {}, fixed(found.estimate)), " ", el("small", {}, bounds(found))];
}

/* ---- statistics: those of bench/statistics/estimates.py, for the cells that are left ---- */
const average = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
function tQuantile(freedom) {
  const after = data.t.findIndex(([df]) => df >= freedom);
  if (after <= 0) return data.t[after < 0 ? data.t.length - 1 : 0][1];
  const [[low, from], [high, to]] = [data.t[after - 1], data.t[after]];
  return to + ((from - to) * (1 / freedom - 1 / high)) / (1 / low - 1 / high);
}
function interval(one, places) {
  const runs = one.cells[0].runs.length, scenarios = one.scenarios;
  const means = Array.from({ length: runs }, (_, run) => average(places.map((place) => one.cells[place].runs[run])));
  const share = Math.min(1, Math.max(0, average(means)));
  const parts = [];
  if (runs > 1) parts.push([means.reduce((sum, value) => sum + (value - share) ** 2, 0) / (runs * (runs - 1)), runs - 1]);
  const block = average(places.flatMap((x) => places.map((y) => one.covariance[Math.max(x, y)][Math.min(x, y)])));
  if (scenarios > 1) parts.push([Math.max(0, block), scenarios - 1]);
  if (!parts.length) return { estimate: share, low: null, high: null };
  const variance = parts.reduce((sum, [part]) => sum + part, 0);
  const freedom = parts.reduce((sum, [part, df]) => sum + part ** 2 / df, 0);
  const joint = variance > 0 ? tQuantile(variance ** 2 / freedom) ** 2 * variance : 0;
  const apart = parts.reduce((sum, [part, df]) => sum + tQuantile(df) ** 2 * part, 0);
  const spread = share * (1 - share), alone = data.t[data.t.length - 1][1] ** 2 / (runs * scenarios * places.length);
  const ratio = spread > 0 ? (joint + apart) / 2 / spread : alone;
  const centre = (share + ratio / 2) / (1 + ratio), half = Math.sqrt(ratio * spread + ratio ** 2 / 4) / (1 + ratio);
  return { estimate: share, low: Math.max(0, Math.min(centre - half, share)), high: Math.min(1, Math.max(centre + half, share)) };
}
function kept(cells) {
  return cells.filter(({ cell }) => Object.entries(state.axes).every(([axis, values]) => values.has(cell[axis])));
}
function over(one, whole) {
  const left = kept(one.cells);
  if (!left.length) return null;
  return left.length === one.cells.length ? whole : interval(one, left.map((cell) => one.cells.indexOf(cell)));
}
function mean(one, name, whole) {
  const left = kept(one.cells);
  return left.length === one.cells.length ? whole : average(left.map((cell) => cell[name]));
}
function ranked(rows) {
  return [...rows].sort((a, b) => a.row.flagged - b.row.flagged || b.score.estimate - a.score.estimate);
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
  return el("a", { href: `#pair-${pair.key}` }, text);
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
  const shown = columns.filter((column) => !column.copied);
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
      el("td", { class: [column.number && "number", column.class].filter(Boolean).join(" ") || null }, ...[column.show(row)].flat())));
  });
  table.replaceChildren(el("thead", {}, head), el("tbody", {}, ...body));
  table.copied = () => [columns.filter((c) => c.value).map((c) => c.name), ...ordered.map((row) => columns.filter((c) => c.value).map((c) => (c.copy ?? c.value)(row)))];
  if (focused?.startsWith(`${id} `)) table.querySelector(`[data-column="${CSS.escape(focused)}"]`)?.focus();
}
const shortest = (value) => (typeof value === "number" ? Number(value.toFixed(4)).toString() : value == null ? "" : String(value));
function csv(lines) {
  return lines.map((line) => line.map((value) => {
    // A spreadsheet takes these for formulas.
    const text = (typeof value === "string" && /^[=+\-@\t\r]/.test(value) ? "'" : "") + shortest(value);
    return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  }).join(",")).join("\n") + "\n";
}
function latex(lines) {
  const escape = (value) => (typeof value === "number" ? value.toFixed(Number.isInteger(value) ? 0 : 2) : shortest(value))
    .replace(/[\\&%$#_{}~^]/g, (c) => ({ "\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}" })[c] ?? `\\${c}`).replaceAll("×", "$\\times$").replaceAll("−", "$-$");
  const rows = lines.map((line) => line.map(escape).join(" & ") + " \\\\");
  const align = lines[0].map((_, i) => (lines.slice(1).every((line) => typeof line[i] === "number" || line[i] == null) ? "r" : "l")).join("");
  return ["\\begin{tabular}{" + align + "}", "\\toprule", rows[0], "\\midrule", ...rows.slice(1), "\\bottomrule", "\\end{tabular}"].join("\n") + "\n";
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
const joined = (values) => values.join(" × ");

function options(select, values, chosen) {
  select.replaceChildren(...values.map(([value, text]) => el("option", { value, selected: String(value) === String(chosen) }, text)));
}
function setTrack(track) {
  state.track = track; state.board = 0; state.shown = null; state.sort = {};
  for (const button of document.querySelectorAll("nav button")) button.setAttribute("aria-pressed", button.dataset.track === track);
  at("thesis").hidden = track !== "thesis";
  at("method").hidden = track !== "method";
  at("board").hidden = !boards().length;
  if (boards().length) setBoard(0);
}
function setBoard(place) {
  state.board = place; state.shown = null;
  const board = current();
  options(at("threat"), boards().map((one, i) => [i, `${one.world.name}, ${one.grid}: ${threatName(one.threat)}`]), place);
  state.axes = Object.fromEntries(board.axes.map((axis) => [axis.name, new Set(axis.values)]));
  const ordered = [...board.axes].sort((a, b) => b.perceptual - a.perceptual);
  at("axes").replaceChildren(...ordered.map((axis) => el("fieldset", {}, el("legend", { title: axis.meaning }, capital(axis.name) + (axis.unit ? ` (${axis.unit})` : "")),
    ...axis.values.map((value) => el("label", {}, el("input", {
      type: "checkbox", checked: true, name: axis.name, value, onchange: (event) => {
        if (event.target.checked) state.axes[axis.name].add(value); else state.axes[axis.name].delete(value);
        render();
      } }), String(value))))));
  for (const kind of ["defense", "victim"]) {
    state[kind] = "";
    options(at(kind), [["", "all"], ...[...new Set(board.rows.map((row) => row[kind].name))].sort().map((name) => [name, name])], "");
  }
  state.attack = "";
  options(at("attack"), [["", "all"], ...[...new Set(within(board).map((pair) => pair.attack.name))].sort().map((name) => [name, name])], "");
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
  const rows = ranked(board.rows.filter(chosen).map((row) => ({ row, score: over(row, row.score) })).filter((one) => one.score));
  const baselines = board.baselines.map((baseline) => ({ baseline, score: over(baseline, baseline.score) })).filter((one) => one.score);
  const metric = said().title;
  const total = new Set(board.rows.flatMap((row) => row.cells.map(({ cell }) => place(cell)))).size;
  const left = new Set(board.rows.flatMap((row) => kept(row.cells).map(({ cell }) => place(cell)))).size;
  at("scope").textContent = `${threatText(board.threat)}. ${left} of ${total} cells; ${metric}, mean with its 95 % interval.` + (left === total ? "" : " Ranks and flags are those of all cells.") +
    (rows.length ? "" : " Nothing was driven in the cells that are left.");

  const whole = left === total;
  const columns = [
    { name: "Rank", show: (one) => (one.row ? String(one.row.group) : ""), value: (one) => one.row?.group ?? null },
    { name: "Defence", class: "name", show: (one) => (one.row ? el("a", { href: "#grid", onclick: () => { state.shown = `r${board.rows.indexOf(one.row)}`; render(); } }, one.row.defense.label) : one.baseline.name), value: (one) => one.row?.defense.label ?? one.baseline.name },
    { name: "Victim", show: (one) => one.row?.victim.label ?? "", value: (one) => one.row?.victim.label ?? "" },
    { name: "Worst case", show: (one) => estimate(one.score), value: (one) => one.score.estimate, number: true },
    { name: "95 %", copied: true, value: (one) => bounds(one.score) },
    { name: "0 – 1", show: (one) => strip(one.score, baselineOf(one)) },
    ...(said().failure ? [{ name: capital(said().failure_title), show: (one) => (one.row ? percent(failedOf(one)) : ""), value: (one) => (one.row ? failedOf(one) : null), number: true }] : []),
    { name: "Worst cell", show: (one) => worstCell(one), value: (one) => lowest(one)?.estimate ?? null, number: true },
    { name: "Clean", show: (one) => (whole ? fixed(one.row?.clean?.estimate) : fixed(cleanOf(one)?.estimate)), value: (one) => (whole ? one.row?.clean?.estimate : cleanOf(one)?.estimate) ?? null, number: true },
    ...(said().baseline ? [{ name: `Against ${said().baseline.replace(/^the /, "")}`, show: (one) => (one.row ? lead(one, whole) : ""), value: (one) => leadOf(one, whole)?.estimate ?? null, number: true }] : []),
    { name: "Strongest attack", class: "name", show: (one) => (one.row ? cardLink(pairs.get(one.row.strongest), pairs.get(one.row.strongest).attack.label) : ""), value: (one) => (one.row ? pairs.get(one.row.strongest).attack.label : "") },
    { name: "Flags", class: "doubts", show: (one) => (one.row ? doubts(one.row) : ""), value: (one) => (one.row ? one.row.flags.filter((flag) => flag.fired).map((flag) => flag.name).join(" ") : "") },
  ];
  draw("ranks", columns, [...rows, ...baselines], (one, before, unsorted) =>
    [one.baseline ? "baseline" : "", one.row?.flagged ? "flagged" : "", unsorted && before && one.row?.group !== before.row?.group ? "group" : ""].filter(Boolean).join(" "));

  drawPairs(board, metric);
  drawMatrix(board);
  drawCurves(board);
  drawHeat(board);
}
function sameDefended(a, b) {
  return ["defense", "victim"].every((kind) => JSON.stringify([a[kind].name, a[kind].params]) === JSON.stringify([b[kind].name, b[kind].params]));
}
function cleanOf(one) {
  if (!one.row) return null;
  const strongest = pairs.get(one.row.strongest);
  const control = data.pairs.find((pair) => pair.attack.name === "none" && pair.track === strongest.track &&
    sameDefended(pair, strongest));
  return control ? over(control, control.score) : null;
}
function besideBaseline(row) {
  return kept(row.cells).filter((cell) => cell.baseline != null);
}
function baselineOf(one) {
  const cells = one.row ? besideBaseline(one.row) : [];
  return cells.length ? average(cells.map((cell) => cell.baseline)) : null;
}
function leadOf(one, whole) {
  if (!one.row) return null;
  if (whole) return one.row.lead;
  const differences = besideBaseline(one.row).map((cell) => average(cell.runs) - cell.baseline);
  return differences.length ? { estimate: average(differences), low: null, high: null } : null;
}
function lead(one, whole) {
  const found = leadOf(one, whole);
  return found ? [el("b", {}, signed(found)), " ", el("small", {}, found.low == null ? "" : `${fixed(found.low)} … ${fixed(found.high)}`)] : "—";
}
const failedOf = ({ row }) => mean(row, "failed", row.failed?.estimate ?? null);
function lowest(one) {
  const cells = one.row ? kept(one.row.cells) : [];
  return cells.length ? cells.reduce((least, cell) => (cell.estimate < least.estimate ? cell : least)) : null;
}
function worstCell(one) {
  const cell = lowest(one);
  return cell ? [el("b", {}, fixed(cell.estimate)), " ", el("small", {}, joined(Object.values(cell.cell)))] : "";
}
function doubts(row) {
  const fired = row.flags.filter((flag) => flag.fired);
  const unmeasured = row.flags.filter((flag) => flag.fired === null).length;
  const summary = fired.length ? `⚑ ${fired.map((flag) => flag.title).join("; ")}` : `none of ${row.flags.length - unmeasured}`;
  return el("details", {}, el("summary", { class: fired.length ? null : "quiet" }, summary), el("ul", {}, ...row.flags.map((flag) =>
    el("li", {}, el("b", {}, `${flag.fired ? "⚑ " : ""}${flag.name.replaceAll("_", " ")}: `), flag.reason))));
}
/* By how much an attack lowers the score of its row further than all the others do. */
function added(pair, row) {
  const place = row ? row.pairs.indexOf(pair.key) : -1;
  return place < 0 ? null : row.marginal[place];
}
function adds(pair, row) {
  const found = added(pair, row);
  return found ? [fixed(found.estimate), " ", el("small", {}, found.low == null ? "" : `${fixed(found.low)} … ${fixed(found.high)}`)] : "";
}
function drawPairs(board, metric) {
  const rows = within(board).filter(chosen).filter((pair) => !state.attack || pair.attack.name === state.attack)
    .map((pair) => ({ pair, score: over(pair, pair.score) })).filter((one) => one.score);
  const rowOf = (pair) => board.rows.find((row) => sameDefended(row, pair));
  const failed = ({ pair }) => mean(pair, "failed", pair.measures[said().failure]?.estimate ?? null);
  const queries = ({ pair }) => mean(pair, "queries", pair.queries);
  draw("pairs", [
    { name: "Attack", class: "name", show: ({ pair }) => cardLink(pair, pair.attack.label), value: ({ pair }) => pair.attack.label },
    { name: "Defence", class: "name", show: ({ pair }) => pair.defense.label, value: ({ pair }) => pair.defense.label },
    { name: "Victim", show: ({ pair }) => pair.victim.label, value: ({ pair }) => pair.victim.label },
    { name: "Threat model", show: ({ pair }) => threatShort(pair.threat), value: ({ pair }) => threatShort(pair.threat) },
    { name: capital(metric), show: (one) => [estimate(one.score), el("small", {}, " ", part(one.pair, rowOf(one.pair)))].flat(), value: (one) => one.score.estimate, number: true },
    { name: "95 %", copied: true, value: (one) => bounds(one.score) },
    { name: "0 – 1", show: (one) => strip(one.score) },
    ...(said().failure ? [{ name: capital(said().failure_title), show: (one) => percent(failed(one)), value: failed, number: true }] : []),
    { name: "Asks", show: ({ pair }) => pair.asks, value: ({ pair }) => pair.asks },
    { name: "Queries", show: (one) => fixed(queries(one), 0), value: queries, number: true },
    { name: "Adds", show: ({ pair }) => adds(pair, rowOf(pair)), value: ({ pair }) => added(pair, rowOf(pair))?.estimate ?? null, number: true },
    { name: "Recording", show: ({ pair }) => (pair.card.recording ? el("a", { href: data.recordings + pair.card.recording }, "rrd") : "") },
  ], rows);
}

/* ---- colour: cividis, safe for colour-blind eyes ---- */
const STOPS = [[0, 34, 78], [66, 78, 108], [125, 124, 120], [188, 175, 111], [254, 232, 56]];
function tint(value) {
  const place = Math.max(0, Math.min(1, value)) * (STOPS.length - 1);
  const low = Math.min(Math.floor(place), STOPS.length - 2);
  const rgb = STOPS[low].map((from, i) => Math.round(from + (STOPS[low + 1][i] - from) * (place - low)));
  const light = (0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2]) / 255;
  return `background: rgb(${rgb.join(", ")}); color: ${light > 0.45 ? "#111" : "#fff"}`;
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
function drawMatrix(board) {
  const rows = board.rows.filter(chosen);
  const all = within(board).filter(chosen);
  const controls = all.filter((pair) => pair.attack.name === "none");
  const label = (pair) => (pair.attack.name === "none" ? "no attack" : pair.attack.label + (pair.threat.budget === board.threat.budget && pair.threat.access === board.threat.access && pair.threat.queries === board.threat.queries ? "" : ` (${threatShort(pair.threat)}, ${pair.threat.queries})`));
  const driven = (attack) => all.reduce((sum, pair) => sum + (label(pair) === attack ? pair.cells.length : 0), 0);
  const attacks = [...new Set([...controls, ...all.filter((pair) => pair.attack.name !== "none")].map(label))]
    .sort((a, b) => (b === "no attack") - (a === "no attack") || driven(b) - driven(a));
  const find = (row, attack) => all.find((pair) => label(pair) === attack && sameDefended(pair, row));
  const scored = rows.map((row) => attacks.map((attack) => { const pair = find(row, attack); return pair && { pair, score: over(pair, pair.score) }; }));
  at("matrix").replaceChildren(
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "Defence · victim"), ...attacks.map((attack) => el("th", { scope: "col" }, attack)))),
    el("tbody", {}, ...rows.map((row, i) => el("tr", {}, el("th", { scope: "row" }, `${row.defense.label} · ${row.victim.label}`),
      ...scored[i].map((one) => (one?.score ? el("td", { class: "value", style: tint(one.score.estimate) }, cardLink(one.pair, fixed(one.score.estimate)), el("small", {}, bounds(one.score)), el("small", {}, part(one.pair, rows[i]))) : el("td", { class: "value" }, "")))))));
  at("matrix").copied = () => [["defence", "victim", ...attacks], ...rows.map((row, i) => [row.defense.label, row.victim.label, ...scored[i].map((one) => one?.score?.estimate ?? null)])];
}
function drawCurves(board) {
  const shown = data.curves.map((curve) => ({ ...curve, first: pairs.get(curve.points[0].pair) }))
    .filter((curve) => curve.first.track === board.track && chosen(curve.first) && curve.first.threat.norm === board.threat.norm &&
      board.rows.some((row) => row.defense.label === curve.first.defense.label && row.victim.label === curve.first.victim.label));
  at("curves-section").hidden = !shown.length;
  at("curves").replaceChildren(...shown.slice(0, 60).map((curve) => figure(curve, board)));
}
function figure(curve, board) {
  const W = 340, H = 190, L = 34, B = 34, T = 8, R = 12, ns = "http://www.w3.org/2000/svg";
  const points = curve.kind === "budget" && curve.clean ? [{ x: 0, ...curve.clean }, ...curve.points] : curve.points;
  const log = curve.kind === "queries" && points[0].x > 0;
  const scale = (x) => (log ? Math.log10(x) : x);
  const low = scale(points[0].x), high = scale(points[points.length - 1].x) || 1;
  const X = (x) => L + ((scale(x) - low) / (high - low || 1)) * (W - L - R), Y = (y) => H - B - Math.max(0, Math.min(1, y)) * (H - B - T);
  const make = (tag, attributes, text) => { const made = document.createElementNS(ns, tag); for (const [k, v] of Object.entries(attributes)) made.setAttribute(k, v); if (text != null) made.textContent = text; return made; };
  const svg = make("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": points.map((p) => `${p.x}: ${fixed(p.estimate)}`).join("; ") });
  for (const y of [0, 0.5, 1]) svg.append(make("path", { class: "axis", d: `M${L} ${Y(y)}H${W - R}` }), make("text", { x: L - 6, y: Y(y) + 4, "text-anchor": "end" }, String(y)));
  svg.append(make("path", { class: "band", d: "M" + points.map((p) => `${X(p.x)} ${Y(p.high ?? p.estimate)}`).join("L") + "L" + [...points].reverse().map((p) => `${X(p.x)} ${Y(p.low ?? p.estimate)}`).join("L") + "Z" }));
  svg.append(make("path", { class: "line", d: "M" + points.map((p) => `${X(p.x)} ${Y(p.estimate)}`).join("L") }));
  for (const p of points) svg.append(make("circle", { cx: X(p.x), cy: Y(p.estimate), r: 3 }), make("text", { x: X(p.x), y: H - B + 15, "text-anchor": "middle" }, p.x >= 100 ? Math.round(p.x) : +p.x.toFixed(3)));
  const unit = curve.kind === "budget" ? `budget (${board.threat.norm})` : said().queries_title;
  svg.append(make("text", { x: (L + W - R) / 2, y: H - 4, "text-anchor": "middle" }, unit + (log ? ", log scale" : "")));
  return el("figure", {}, svg, el("figcaption", { title: curve.cells.map((cell) => joined(Object.values(cell))).join("; ") }, `${curve.first.attack.label} on ${curve.first.defense.label} · ${curve.first.victim.label}, ${curve.cells.length} cell${curve.cells.length > 1 ? "s" : ""}${curve.left_out ? ` (${curve.left_out} at the floor or the ceiling left out)` : ""}`));
}

/* ---- the card of a pair: #pair-12 ---- */
function showCard() {
  const key = /^#pair-(\d+)$/.exec(location.hash)?.[1];
  const pair = key && pairs.get(+key), dialog = at("card");
  if (!pair) { if (dialog.open) dialog.close(); return; }
  const card = pair.card, words = (values) => values.join(", ") || "none";
  const params = (component) => [component.name, ...Object.entries(component.params).map(([k, v]) => `${k}=${JSON.stringify(v)}`)].join(" ");
  const fact = (name, ...value) => [el("dt", {}, name), el("dd", {}, ...value)];
  const command = (text) => [el("code", {}, text), el("button", { type: "button", onclick: () => copy(text, "Command") }, "Copy")];
  dialog.replaceChildren(
    el("div", { class: "bar" }, el("h2", { id: "card-title" }, card.pair), el("button", { type: "button", onclick: () => dialog.close() }, "Close")),
    el("dl", {},
      ...fact("score", ...estimate(pair.score)),
      ...["attack", "defense", "victim", "world"].flatMap((kind) => fact(kind === "defense" ? "defence" : kind, params(card.components[kind]), el("br"), el("small", { class: "quiet" }, words(card.shipped_by[kind])))),
      ...fact("threat model", pair.threat.budget ? threatName(pair.threat) : "nothing is attacked"),
      ...fact("training seeds", words(card.training_seeds)),
      ...fact("scenario seeds", `${card.scenario_seeds[0]} to ${card.scenario_seeds[1]} (${words(card.grid)}), ${pair.cells.length} cells, ${card.episodes} episodes` + (card.left_out ? `; ${card.left_out} left out` : "")),
      ...fact("weights", words(card.weights_sha256)),
      ...(card.artefact_sha256.length ? fact(data.tracks[pair.track].artefact, words(card.artefact_sha256)) : []),
      ...fact("code", words(card.code_digest)),
      ...fact("libraries", ...card.libraries.map((one) => el("div", {}, Object.entries(one).map(([k, v]) => `${k} ${v}`).join(", ")))),
      ...fact("machine", words(card.machine)),
      ...fact("finished", `${card.finished}, ${card.wall_s} s of work`),
      ...fact("run it again", ...command(card.run)),
      ...fact("replay an episode", ...command(card.replay)),
      ...fact("recording", card.recording ? el("a", { href: data.recordings + card.recording }, card.recording) : "none here; the command above makes one"),
    ));
  if (!dialog.open) dialog.showModal();
}
at("card").addEventListener("close", () => { if (location.hash.startsWith("#pair-")) history.replaceState(null, "", location.pathname + location.search); });
at("card").addEventListener("click", (event) => { if (event.target === at("card")) at("card").close(); });
addEventListener("hashchange", showCard);

for (const button of document.querySelectorAll("nav button")) button.addEventListener("click", () => setTrack(button.dataset.track));
at("threat").addEventListener("change", (event) => setBoard(+event.target.value));
for (const kind of ["defense", "victim", "attack"]) at(kind).addEventListener("change", (event) => { state[kind] = event.target.value; render(); });
at("shown").addEventListener("change", (event) => { state.shown = event.target.value; render(); });
at("filters").addEventListener("reset", (event) => { event.preventDefault(); setBoard(state.board); });
at("filters").addEventListener("submit", (event) => event.preventDefault());
setTrack(document.querySelector("nav button").dataset.track);
showCard();
