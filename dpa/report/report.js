"use strict";
// Draws the figures of the page, one after the other so that it stays awake, and those of a folded part when it opens.
(() => {
  const config = {
    displaylogo: false, responsive: true, showTips: false, displayNotifier: false,
    showSendToCloud: false, plotlyServerURL: "",  // on by default: a button that uploads the figure to a third party
    modeBarButtonsToRemove: ["select2d", "lasso2d", "zoomIn2d", "zoomOut2d", "autoScale2d"],
    toImageButtonOptions: { format: "svg" },
  };
  const coarse = window.matchMedia("(pointer: coarse)").matches;
  const waiting = new Set(document.querySelectorAll(".plot"));

  function draw(place) {
    const { data, layout } = JSON.parse(place.nextElementSibling.textContent);
    // A finger on a figure scrolls the page; a mouse zooms into the figure.
    layout.dragmode = coarse ? false : "zoom";
    layout.autosize = true;
    return Plotly.newPlot(place, data, layout, config);
  }

  let running = false;
  async function drawShown() {
    if (running) return;
    running = true;
    document.body.dataset.drawn = "no";
    for (let next; (next = [...waiting].find((place) => place.checkVisibility()));) {
      waiting.delete(next);
      await draw(next);
      await new Promise((resolve) => setTimeout(resolve));
    }
    document.body.dataset.drawn = "yes";
    running = false;
  }

  // The window may have changed while a figure was hidden.
  function refit(part) {
    for (const place of part.querySelectorAll(".js-plotly-plot")) if (place.checkVisibility()) Plotly.Plots.resize(place);
  }

  function select(tab) {
    const group = tab.closest(".tabs"), buttons = [...group.querySelectorAll(":scope > [role=tablist] > [role=tab]")];
    for (const button of buttons) {
      const chosen = button === tab;
      button.setAttribute("aria-selected", String(chosen));
      button.tabIndex = chosen ? 0 : -1;
      document.getElementById(button.getAttribute("aria-controls")).hidden = !chosen;
    }
    refit(group);
    drawShown();
  }

  for (const tab of document.querySelectorAll("[role=tab]")) {
    tab.addEventListener("click", () => select(tab));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      const next = step && (step > 0 ? tab.nextElementSibling : tab.previousElementSibling);
      if (next) { select(next); next.focus(); }
    });
    if (tab.getAttribute("aria-selected") === "true") select(tab);
  }
  for (const part of document.querySelectorAll("details")) part.addEventListener("toggle", () => { refit(part); drawShown(); });
  window.addEventListener("beforeprint", drawShown);

  // The index marks the section that is read.
  const links = new Map([...document.querySelectorAll("nav a")].map((link) => [link.hash.slice(1), link]));
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      for (const link of links.values()) link.removeAttribute("aria-current");
      links.get(entry.target.id)?.setAttribute("aria-current", "true");
    }
  }, { rootMargin: "-10% 0px -80% 0px" });
  for (const section of document.querySelectorAll("main > section[id]")) seen.observe(section);
  drawShown();
})();
