// Sphinx's own scores, and guides before records: whoever looks for `resolution` wants its meaning first.
var Scorer = {
  score: (result) => {
    const [page, , , , score] = result;
    if (/^(settings|problems|tuning|robots|runs|operations|deploy|start)$|^tutorials\//.test(page)) return score + 4;
    if (/^(changelog|benchmarks|release|contributing)$|^decisions\//.test(page)) return score - 4;
    return score;
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
