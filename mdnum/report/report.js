"use strict";
(() => {
  const PAGE = 25;
  const raised = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
  function number(value, digits) {
    if (value === 0) return "0";
    const [mantissa, power] = value.toExponential(digits - 1).split("e");
    const text = Math.abs(power) < 4
      ? value.toFixed(Math.max(0, digits - 1 - Number(power)))
      : `${mantissa} × 10${[...String(Number(power))].map((sign) => raised[sign]).join("")}`;
    return text.replace("-", "−");
  }

  function text(column, row) {
    const value = row[column.at];
    if (column.kind === "pair") return `${value}–${row[column.at + 1]}`;
    if (value === null) return column.missing;
    if (column.kind === "word") return column.words[value];
    if (column.kind === "count") return value.toLocaleString("en").replace("-", "−");
    if (column.kind === "fixed") return value.toFixed(column.digits).replace("-", "−");
    return column.kind === "number" ? number(value, column.digits) : String(value);
  }

  function browse(place) {
    const table = place.querySelector("table");
    const read = (id) => JSON.parse(document.getElementById(id).textContent);
    const spec = read(`${table.id}-spec`);
    const rows = read(spec.rows);
    const body = table.tBodies[0];
    const search = place.querySelector("input");
    const found = place.querySelector("output");
    const pager = place.querySelector(".pager");
    const [back, forth] = pager.querySelectorAll("button");
    const where = pager.querySelector("span");
    let sorted = spec.columns[0], ascending = true, page = 0, shown = rows;
    const ambiguous = (row) => spec.ambiguous !== null && row[spec.ambiguous] !== null && row[spec.ambiguous] <= 1;

    // one condition a word; all must hold
    function condition(word) {
      let match;
      if (Object.hasOwn(spec.words, word)) {
        const [column, value] = spec.words[word];
        return (row) => row[column] === value;
      }
      if (spec.nouns.includes(word)) return () => true;
      if (word === "ambiguous" && spec.ambiguous !== null) return ambiguous;
      if ((match = word.match(/^([a-z]+):(\d+)?(\.\.)?(\d+)?$/)) && Object.hasOwn(spec.ranges, match[1])) {
        const column = spec.ranges[match[1]];
        const low = match[2] ? Number(match[2]) : -Infinity;
        const high = match[4] ? Number(match[4]) : match[3] ? Infinity : low;
        return (row) => row[column] >= low && row[column] <= high;
      }
      const [first, second] = spec.subjects;
      if (second !== undefined && (match = word.match(/^(\d+)[-–](\d+)$/))) {
        const pair = [Number(match[1]), Number(match[2])].sort((a, b) => a - b);
        return (row) => row[first] === pair[0] && row[second] === pair[1];
      }
      if (spec.subjects.length && /^\d+$/.test(word)) {
        return (row) => spec.subjects.some((column) => row[column] === Number(word));
      }
      return null;
    }

    const key = (row, at) => (row[at] === null ? Infinity : row[at]);
    function compare(a, b, at) {
      const left = key(a, at), right = key(b, at);
      return left < right ? -1 : left > right ? 1 : 0;
    }

    function select() {
      const words = search.value.trim().toLowerCase().split(/\s+/).filter(Boolean);
      const conditions = words.map(condition);
      const unknown = words.filter((_, index) => conditions[index] === null);
      search.setAttribute("aria-invalid", unknown.length > 0);
      shown = unknown.length ? [] : rows.filter((row) => conditions.every((holds) => holds(row)));
      const sign = ascending ? 1 : -1;
      // ties keep the order of rows, and pairs are ordered by both of their members
      shown = [...shown].sort((a, b) => sign * (
        compare(a, b, sorted.at) || (sorted.kind === "pair" ? compare(a, b, sorted.at + 1) : 0)
      ));
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
        if (ambiguous(row)) line.className = "ambiguous";
        for (const column of spec.columns) {
          const cell = document.createElement("td");
          cell.textContent = text(column, row);
          if (column.kind === "word" || column.kind === "text") {
            cell.className = `words ${column.colors[row[column.at]] ?? ""}`.trim();
          }
          line.append(cell);
        }
        return line;
      }));
      pager.hidden = pages === 1;
      back.disabled = page === 0;
      forth.disabled = page === pages - 1;
      where.textContent = `page ${page + 1} of ${pages}`;
      for (const head of table.tHead.rows[0].cells) {
        if (Number(head.dataset.column) === sorted.at) {
          head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
        } else head.removeAttribute("aria-sort");
      }
    }

    for (const head of table.tHead.rows[0].cells) {
      head.querySelector("button").addEventListener("click", () => {
        const chosen = spec.columns.find((column) => column.at === Number(head.dataset.column));
        ascending = chosen === sorted ? !ascending : true;
        sorted = chosen;
        select();
      });
    }
    search.addEventListener("input", select);
    back.addEventListener("click", () => { page -= 1; draw(); });
    forth.addEventListener("click", () => { page += 1; draw(); });
    for (const element of place.querySelectorAll("[data-needs-script]")) element.hidden = false;
    select();
  }

  for (const place of document.querySelectorAll(".browse")) browse(place);
})();
