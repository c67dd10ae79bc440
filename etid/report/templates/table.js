"use strict";
for (const table of document.querySelectorAll("table.searchable")) {
  const body = table.tBodies[0];
  const rows = [...body.rows];
  const box = document.createElement("input");
  box.type = "search";
  box.placeholder = "Search this table";
  box.setAttribute("aria-label", box.placeholder);
  box.addEventListener("input", () => {
    const wanted = box.value.toLowerCase();
    for (const row of rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
  });
  table.parentElement.before(box);
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const text = (row) => row.cells[column].textContent.trim();
      const numbers = rows.map((row) => parseFloat(text(row)));
      const numeric = numbers.some((value) => !Number.isNaN(value));
      // Cells without a number come last in both orders.
      const order = rows.map((row, i) => [row, numbers[i]]);
      order.sort(([a, x], [b, y]) => {
        const way = up ? 1 : -1;
        if (!numeric) return way * text(a).localeCompare(text(b), undefined, { numeric: true });
        if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
        return way * (x - y);
      });
      body.append(...order.map(([row]) => row));
    });
  });
}
