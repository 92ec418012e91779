// Of a page, only what the build marked as mathematics; of a notebook, what stands between dollar signs.
const notebook = document.querySelector(".jupyter-wrapper") !== null;
window.MathJax = {
  tex: {
    inlineMath: [notebook ? ["$", "$"] : ["\\(", "\\)"]],
    displayMath: [notebook ? ["$$", "$$"] : ["\\[", "\\]"]],
    processEscapes: true,
  },
  options: notebook ? {} : { ignoreHtmlClass: ".*|", processHtmlClass: "arithmatex" },
};
