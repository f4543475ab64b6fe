// The order of the results of the search: pages before members of classes, the history and the notes of developers.
var Scorer = {
  score: ([docname, title, anchor, descr, score]) => {
    if (/^(changelog|contributing|notebook_)/.test(docname)) return score - 4;
    if (!docname.startsWith("made/api/")) return score;
    return score - (/\.[a-z_]+$/.test(anchor) ? 25 : /^[A-Z]\w*$/.test(title) || /\.[A-Z]\w*$/.test(title) ? 8 : 12);
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
