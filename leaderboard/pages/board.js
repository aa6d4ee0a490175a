
"use strict";
(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  document.documentElement.classList.add("js");
  const sections = all("section.track");
  if (!sections.length) return;
  const choice = document.getElementById("track");
  const filter = document.getElementById("filter");
  const ranked = document.getElementById("ranked");
  const count = document.getElementById("count");

  const valueOf = (row, column) => {
    const cell = row.cells[column];
    const text = cell.dataset.value ?? cell.textContent.trim();
    const number = Number(text);
    return text === "" ? null : Number.isNaN(number) ? text.toLowerCase() : number;
  };

  const sort = (header) => {
    const rows = all("tbody tr", header.closest("table"));
    const down = header.ariaSort ? header.ariaSort === "ascending" : header.dataset.first === "down";
    all("th[aria-sort]", header.parentElement).forEach((other) => other.removeAttribute("aria-sort"));
    header.setAttribute("aria-sort", down ? "descending" : "ascending");
    const column = header.cellIndex;
    rows.map((row) => [valueOf(row, column), row]).sort(([a], [b]) => {
      if (a === null || b === null) return (a === null) - (b === null);  // what is missing comes last
      const order = typeof a === "string" ? a.localeCompare(b) : a - b;
      return down ? -order : order;
    }).forEach(([, row]) => row.parentElement.append(row));
  };

  const refresh = () => {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    sections.forEach((section) => { section.hidden = section.id !== choice.value; });
    const shown = document.getElementById(choice.value);
    const rows = all("tbody tr", shown);
    rows.forEach((row) => {
      const text = row.dataset.text.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word)) ||
        (ranked.checked && row.classList.contains("unranked"));
    });
    count.textContent = `${rows.filter((row) => !row.hidden).length} of ${rows.length} rows`;
  };

  const follow = () => {
    const wanted = decodeURIComponent(location.hash.slice(1));
    if (sections.some((section) => section.id === wanted)) choice.value = wanted;
    refresh();
  };

  all("section.track thead button").forEach((button) =>
    button.addEventListener("click", () => sort(button.closest("th"))));
  choice.addEventListener("change", () => {
    history.replaceState(null, "", `#${choice.value}`);
    refresh();
  });
  filter.addEventListener("input", refresh);
  ranked.addEventListener("change", refresh);
  addEventListener("hashchange", follow);
  follow();
})();
