/* Ranks the entries of the site for a query, in place of what searchtools.js of Sphinx does: see site_search.py. */
"use strict";

/* Entries are ranked by BM25 (Robertson and Zaragoza 2009), with parameters as they are usual. */
const SATURATION = 1.2;
const LENGTH_SHARE = 0.5;
const MOST_RESULTS = 40;
/* Results that are this much worse than the best one are not shown. */
const LEAST_SHARE = 0.2;
/* What has the name that was looked for comes first, whatever else was written. */
const NAMED = 1000;
const FEW_WORDS = 3;

/* A page whose heading has all words of the query is about them. */
const HEADING_WEIGHT = 2;

/* What users look up comes before what was, and why. */
const PAGE_WEIGHTS = [
  [/^(decisions\/.*|changelog)$/, 0.3],
  [/^(contributing|release|architecture)$/, 0.6],
];

/* As many words are a message, and fewer a subject. */
const MESSAGE_WORDS = 5;
const ERRORS = "reference/errors";
const errorsWeight = (words) => (words.length >= MESSAGE_WORDS ? 1.5 : 0.7);

const pageWeight = (page) => (PAGE_WEIGHTS.find(([pattern]) => pattern.test(page)) || [null, 1])[1];

/* Of entries of a list, `alarms[2].sensor` is `alarms[].sensor`. */
const withoutNumbers = (text) => text.replace(/\[\d*\]/g, "");

/* The name in a title: `streams.NAME.gaps` is also streams.fan.gaps, `ROOT/SITE/BOX/status` also daqsvc/plant/box1/status. */
const nameIn = (title) => {
  const code = title.match(/^([A-Z]+\d\d): /);
  const name = code ? code[1] : withoutNumbers(title).split(/[ =,]/)[0];
  if (!code && !/[._/-]/.test(name)) return null;
  const pattern = name
    .split(/([./])/)
    .map((part) => (/^[A-Z_]+$/.test(part) ? "[^./\\s]+" : _escapeRegExp(part)))
    .join("");
  return new RegExp(`^${pattern}$`, "i");
};

const wordsOf = (text) => splitQuery(text.toLowerCase()).filter((word) => !stopwords.has(word));

/* What may be a name in a query, without the brackets, quotes and full stops around it. */
const possibleNames = (query) =>
  query.split(/[\s,;:'"`()[\]{}=<>]+/).map((word) => word.replace(/^[./]+|[.?!/]+$/g, "")).filter((word) => word);

/* Adds to the score of each entry that has the words. */
const rankByWords = (text, scores) => {
  const { pages, titles, entries, lengths, terms } = SITE_INDEX;
  const stemmer = new Stemmer();
  const stems = (text) => new Set(wordsOf(text).map((word) => stemmer.stemWord(word)));
  const words = stems(text);
  const mean = lengths.reduce((sum, length) => sum + length, 0) / lengths.length;
  const weights = pages.map((page) => (page === ERRORS ? errorsWeight([...words]) : pageWeight(page)));
  const headings = titles.map((title) => [...words].every((word) => stems(title).has(word)));
  for (const word of words) {
    const listed = Object.hasOwn(terms, word) ? terms[word] : [];
    const rarity = Math.log(1 + (entries.length - listed.length + 0.5) / (listed.length + 0.5));
    for (const [entry, times] of listed) {
      const [page, anchor] = entries[entry];
      const length = 1 - LENGTH_SHARE + (LENGTH_SHARE * lengths[entry]) / mean;
      const weight = weights[page] * (!anchor && headings[page] ? HEADING_WEIGHT : 1);
      const score = (weight * rarity * times * (SATURATION + 1)) / (times + SATURATION * length);
      scores.set(entry, (scores.get(entry) || 0) + score);
    }
  }
};

/* A message that was copied has pairs of words that its text in the source has; names and figures are between them. */
const LEAST_PAIRS = 3;
/* A question is no message, though it has such pairs, too. */
const QUESTION = /^\s*(how|what|where|why|when|which|who|can|does|do|is)\b|\?\s*$/i;

const pairsOf = (text) => {
  const pairs = new Set();
  for (const piece of text.toLowerCase().split("|")) {
    const words = splitQuery(piece);
    for (let i = 1; i < words.length; i++) pairs.add(`${words[i - 1]} ${words[i]}`);
  }
  return pairs;
};

/* Puts the errors first whose messages have most of the query, by the rarity of the pairs. */
const rankByMessages = (query, scores) => {
  const asked = pairsOf(query);
  const had = SITE_INDEX.messages.map(([entry, texts]) => {
    const pairs = new Set(texts.flatMap((text) => [...pairsOf(text)]).filter((pair) => asked.has(pair)));
    return [entry, pairs];
  });
  const times = new Map();
  for (const [, pairs] of had) for (const pair of pairs) times.set(pair, (times.get(pair) || 0) + 1);
  const rarity = (pair) => Math.log(1 + had.length / times.get(pair));
  for (const [entry, pairs] of had) {
    if (pairs.size < LEAST_PAIRS) continue;
    const sum = [...pairs].reduce((sum, pair) => sum + rarity(pair), 0);
    scores.set(entry, Math.max(scores.get(entry) || 0, 3 * NAMED + sum));
  }
};

const siteSearch = (typed) => {
  const query = withoutNumbers(typed);
  const { pages, titles, entries } = SITE_INDEX;
  const scores = new Map();
  const names = possibleNames(query);
  let others = query;
  entries.forEach(([page, , title], entry) => {
    const pattern = nameIn(title);
    for (const name of pattern ? names.filter((name) => pattern.test(name)) : []) {
      scores.set(entry, pages[page] === ERRORS ? 5 * NAMED : NAMED * pageWeight(pages[page]));
      others = others.replaceAll(name, " ");
    }
  });
  /* In a message the words beside the name of a key are those that lead to its code. */
  const named = scores.size > 0;
  rankByWords(wordsOf(others).length >= FEW_WORDS ? others : query, scores);
  const errors = [...scores].filter(([entry]) => pages[entries[entry][0]] === ERRORS);
  if (named && errors.length && wordsOf(others).length >= MESSAGE_WORDS) {
    const [entry, score] = errors.reduce((one, other) => (other[1] > one[1] ? other : one));
    scores.set(entry, Math.max(score, NAMED / 2));
  }
  if (splitQuery(query).length >= MESSAGE_WORDS && !QUESTION.test(query)) rankByMessages(query, scores);
  const best = Math.max(0, ...scores.values());
  const enough = best > NAMED / 4 ? 0 : best * LEAST_SHARE;
  return [...scores]
    .filter(([, score]) => score > enough)
    .sort(([one, a], [other, b]) => b - a || one - other)
    .slice(0, MOST_RESULTS)
    .map(([entry, score]) => {
      const [page, anchor, title, excerpt] = entries[entry];
      const shown = anchor ? `${titles[page]} > ${title}` : title;
      /* Without an excerpt Sphinx would fetch the page, which a browser does not allow of a file. */
      const text = excerpt || titles[page];
      return [pages[page], shown, anchor && `#${anchor}`, text, score, `${pages[page]}.md`, SearchResultKind.text];
    });
};

/* Sphinx shows the last one first. */
Search._performSearch = (query) => siteSearch(query).reverse();

/* Units and single letters, as messages have them, are within many words: marking them marks nearly everything. */
const LEAST_MARKED = 3;
const sphinxQuery = Search._parseQuery;
Search._parseQuery = (query) => {
  const [typed, searched, excluded, marked, objects] = sphinxQuery(query);
  const words = new Set([...marked].filter((word) => word.length >= LEAST_MARKED));
  /* What is marked on the page that is opened from here. */
  localStorage.setItem("sphinx_highlight_terms", [...words].join(" "));
  return [typed, searched, excluded, words, objects];
};
