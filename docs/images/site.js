// Mark tables that are wider than the page; site.css shows their cells below each other, with the names of the columns.
function stackTables() {
  for (const table of document.querySelectorAll(".md-typeset__scrollwrap table")) {
    table.removeAttribute("data-stacked");
    const names = [...table.rows[0].cells].map((cell) => cell.textContent);
    for (const row of table.tBodies[0].rows) [...row.cells].forEach((cell, i) => (cell.dataset.column = names[i]));
    table.toggleAttribute("data-stacked", table.scrollWidth > table.closest(".md-typeset__scrollwrap").clientWidth);
  }
}
addEventListener("load", stackTables);
addEventListener("resize", stackTables);
