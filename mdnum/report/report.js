"use strict";
(() => {
  const PAGE = 25;
  const rows = JSON.parse(document.getElementById("flip-rows").textContent);
  const table = document.getElementById("flips");
  if (!table) return;
  const body = table.tBodies[0];
  const search = document.getElementById("search");
  const found = document.getElementById("found");
  const pager = document.getElementById("pager");
  const [back, forth] = pager.querySelectorAll("button");
  const where = pager.querySelector("span");
  // columns of a row as embedded: step, i, j, entered, distance, margin, radial speed, energy jump, ratio
  const STEP = 0, I = 1, J = 2, ENTERED = 3, RATIO = 8;
  let column = STEP, ascending = true, page = 0, shown = rows;

  const raised = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
  function number(value, digits) {
    if (value === null) return "∞";
    if (value === 0) return "0";
    const [mantissa, power] = value.toExponential(digits - 1).split("e");
    const text = Math.abs(power) < 4
      ? value.toFixed(Math.max(0, digits - 1 - Number(power)))
      : `${mantissa} × 10${[...String(Number(power))].map((sign) => raised[sign]).join("")}`;
    return text.replace("-", "−");
  }

  // one condition a word; all must hold
  function condition(word) {
    let match;
    if (/^(entered|in)$/.test(word)) return (row) => row[ENTERED] === 1;
    if (/^(left|out)$/.test(word)) return (row) => row[ENTERED] === 0;
    if (word === "ambiguous") return (row) => row[RATIO] !== null && row[RATIO] <= 1;
    if ((match = word.match(/^step:(\d+)?(\.\.)?(\d+)?$/))) {
      const low = match[1] ? Number(match[1]) : -Infinity;
      const high = match[3] ? Number(match[3]) : match[2] ? Infinity : low;
      return (row) => row[STEP] >= low && row[STEP] <= high;
    }
    if ((match = word.match(/^(\d+)[-–](\d+)$/))) {
      const pair = [Number(match[1]), Number(match[2])].sort((a, b) => a - b);
      return (row) => row[I] === pair[0] && row[J] === pair[1];
    }
    if (/^\d+$/.test(word)) return (row) => row[I] === Number(word) || row[J] === Number(word);
    return null;
  }

  function select() {
    const words = search.value.trim().toLowerCase().split(/\s+/).filter(Boolean);
    const conditions = words.map(condition);
    const unknown = words.filter((_, index) => conditions[index] === null);
    search.setAttribute("aria-invalid", unknown.length > 0);
    shown = unknown.length ? [] : rows.filter((row) => conditions.every((holds) => holds(row)));
    const sign = ascending ? 1 : -1;
    const key = (row) => (row[column] === null ? Infinity : row[column]);
    // ties keep the order of steps, and pairs are ordered by both atoms
    shown = [...shown].sort((a, b) => sign * (key(a) - key(b) || 0) || (column === I ? sign * (a[J] - b[J]) : 0));
    found.textContent = unknown.length
      ? `“${unknown[0]}” is not understood`
      : `${shown.length.toLocaleString("en")} of ${rows.length.toLocaleString("en")} rows`;
    page = 0;
    draw();
  }

  function draw() {
    const pages = Math.max(1, Math.ceil(shown.length / PAGE));
    body.replaceChildren(...shown.slice(page * PAGE, (page + 1) * PAGE).map((row) => {
      const line = document.createElement("tr");
      if (row[RATIO] !== null && row[RATIO] <= 1) line.className = "ambiguous";
      const cells = [
        row[STEP].toLocaleString("en"), `${row[I]}–${row[J]}`, row[ENTERED] ? "entered" : "left",
        row[4] === null ? "–" : row[4].toFixed(6), number(row[5], 3), number(row[6], 3), number(row[7], 3), number(row[8], 2),
      ];
      cells.forEach((text, index) => {
        const cell = document.createElement("td");
        cell.textContent = text;
        if (index === 2) cell.className = "words " + (row[ENTERED] ? "in" : "out");
        line.append(cell);
      });
      return line;
    }));
    pager.hidden = pages === 1;
    back.disabled = page === 0;
    forth.disabled = page === pages - 1;
    where.textContent = `page ${page + 1} of ${pages}`;
    for (const head of table.tHead.rows[0].cells) {
      const sorted = Number(head.dataset.column) === column;
      if (sorted) head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
      else head.removeAttribute("aria-sort");
    }
  }

  for (const head of table.tHead.rows[0].cells) {
    head.querySelector("button").addEventListener("click", () => {
      const chosen = Number(head.dataset.column);
      ascending = chosen === column ? !ascending : true;
      column = chosen;
      select();
    });
  }
  search.addEventListener("input", select);
  back.addEventListener("click", () => { page -= 1; draw(); });
  forth.addEventListener("click", () => { page += 1; draw(); });
  for (const element of document.querySelectorAll("[data-needs-script]")) element.hidden = false;
  select();
})();
