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

/* An option is looked up by its name, with its dashes; the words of a task lead to where it is explained. */
const OPTION = /^daqsvc-.*--/;
const OPTION_WEIGHT = 0.5;

/* Who asks what a word means is led to the glossary. */
const DEFINITION = /^\s*what (is|are|does|do|means)\b|\bmean(s|ing)?\b/i;
const GLOSSARY = "glossary";
const DEFINITION_WEIGHT = 2;

const pageWeight = (page) => (PAGE_WEIGHTS.find(([pattern]) => pattern.test(page)) || [null, 1])[1];

/* Of entries of a list, `alarms[2].sensor` is `alarms[].sensor`. */
const withoutNumbers = (text) => text.replace(/\[\d*\]/g, "");

/* The name in a title: `streams.NAME.gaps` is also streams.fan.gaps, `ROOT/SITE/BOX/status` also daqsvc/plant/box1/status. */
const nameIn = (title) => {
  const code = title.match(/^([A-Z]+\d\d): /);
  const name = code ? code[1] : withoutNumbers(title).split(/[ =,]/)[0];
  if (!code && !/[._/-]/.test(name)) return null;
  /* What consists of names to be put in, as STATE/HOST, is the name of nothing in particular. */
  if (!code && name.split(/[./]/).every((part) => /^[A-Z_]+$/.test(part))) return null;
  const pattern = name
    .split(/([./])/)
    .map((part) => (/^[A-Z_]+$/.test(part) ? "[^./\\s]+" : _escapeRegExp(part)))
    .join("");
  return new RegExp(`^${pattern}$`, "i");
};

/* What no page has as one word, e.g. sensor_ok, is looked for by its parts. */
const partsOf = (word) => {
  const isKnown = Object.hasOwn(SITE_INDEX.terms, new Stemmer().stemWord(word));
  return isKnown ? [word] : word.split("_").filter((part) => part);
};

const wordsOf = (text) =>
  splitQuery(text.toLowerCase()).flatMap(partsOf).filter((word) => !stopwords.has(word));

const stemsOf = (text) => {
  const stemmer = new Stemmer();
  return new Set(wordsOf(text).map((word) => stemmer.stemWord(word)));
};

/* A counter is looked up by its own name, too: that of its group and of its stream or bus may be left out. */
const COUNTERS = "reference/counters";
const COUNTER_WEIGHT = 1.05;
const lastOf = (title) => withoutNumbers(title).split(/[ =,]/)[0].split(".").pop().toLowerCase();
const namesOfKeys = () => {
  const { pages, entries } = SITE_INDEX;
  return new Set(entries.filter(([page]) => /^reference\/keys/.test(pages[page])).map(([, , title]) => lastOf(title)));
};

/* How much a word tells: the fewer entries have it, the more. */
const rarityOf = (word) => {
  const { entries, terms } = SITE_INDEX;
  const had = Object.hasOwn(terms, word) ? terms[word].length : 0;
  return Math.log(1 + (entries.length - had + 0.5) / (had + 0.5));
};

/* What may be a name in a query, without the brackets, quotes and full stops around it. */
const possibleNames = (query) =>
  query.split(/[\s,;:'"`()[\]{}=<>]+/).map((word) => word.replace(/^[./]+|[.?!/]+$/g, "")).filter((word) => word);

/* Adds to the score of each entry that has the words. */
const rankByWords = (text, scores) => {
  const { pages, titles, entries, lengths, terms } = SITE_INDEX;
  const words = stemsOf(text);
  const mean = lengths.reduce((sum, length) => sum + length, 0) / lengths.length;
  const weights = pages.map((page) => (page === ERRORS ? errorsWeight([...words]) : pageWeight(page)));
  const headings = titles.map((title) => [...words].every((word) => stemsOf(title).has(word)));
  for (const word of words) {
    const listed = Object.hasOwn(terms, word) ? terms[word] : [];
    const rarity = rarityOf(word);
    for (const [entry, times] of listed) {
      const [page, anchor] = entries[entry];
      const length = 1 - LENGTH_SHARE + (LENGTH_SHARE * lengths[entry]) / mean;
      const weight =
        weights[page] * (!anchor && headings[page] ? HEADING_WEIGHT : 1) * (OPTION.test(anchor) ? OPTION_WEIGHT : 1);
      const score = (weight * rarity * times * (SATURATION + 1)) / (times + SATURATION * length);
      scores.set(entry, (scores.get(entry) || 0) + score);
    }
  }
};

/* A question of the list that has the words of the query, and few others, is the query. */
const LEAST_SIMILARITY = 0.3;
const SAME_QUESTION = 0.75;
const QUESTION_WEIGHT = 2;

/* Adds to the score of each entry that answers questions like the query; the similarity of the best one. */
const rankByQuestions = (text, scores) => {
  const { pages, titles, entries, questions, terms } = SITE_INDEX;
  const isAsked = new Set(questions.flatMap(([, those]) => those.flat()));
  /* Words that are nowhere on the site do not count. */
  const words = [...stemsOf(text)].filter((word) => isAsked.has(word) || Object.hasOwn(terms, word));
  const sum = (words) => words.reduce((sum, word) => sum + rarityOf(word), 0);
  const asked = sum(words);
  let most = 0;
  for (const [entry, those] of questions) {
    const [page, , title] = entries[entry];
    const known = new Set([...those.flat(), ...stemsOf(`${titles[page]} ${title}`)]);
    const share = sum(words.filter((word) => known.has(word))) / (asked || 1);
    const nearest = Math.max(
      ...those.map((question) => sum(question.filter((word) => words.includes(word))) / (sum(question) || 1)),
    );
    const similarity = share * Math.sqrt(nearest);
    if (similarity < LEAST_SIMILARITY) continue;
    most = Math.max(most, similarity);
    scores.set(entry, (scores.get(entry) || 0) + QUESTION_WEIGHT * (SATURATION + 1) * asked * similarity);
  }
  return most;
};

/* A message that was copied has pairs of words that its text in the source has; names and figures are between them. */
const LEAST_PAIRS = 3;
/* A question is no message, though it has such pairs, too; the name of a CAN bus is no question. */
const QUESTION = /^\s*(how|what|where|why|when|which|who|can(?! (bus|interface)\b)|does(?! not\b)|do(?! not\b)|is)\b|\?\s*$/i;

const pairsOf = (text) => {
  const pairs = new Set();
  for (const piece of text.toLowerCase().split("|")) {
    const words = splitQuery(piece);
    for (let i = 1; i < words.length; i++) pairs.add(`${words[i - 1]} ${words[i]}`);
  }
  return pairs;
};

/* Figures, quoted names and brackets of a message are those of one machine. */
const OF_ONE_MACHINE = /'[^']*'|"[^"]*"|-?\d[\d.]*/g;

/* Whether one text of the source has all pairs of the query: what is there word for word was copied. */
const isCopied = (query) => {
  const asked = [...pairsOf(query.replace(OF_ONE_MACHINE, "|"))];
  return (
    asked.length >= LEAST_PAIRS &&
    SITE_INDEX.messages.some(([, texts]) =>
      texts.some((text) => {
        const pairs = pairsOf(text);
        return asked.every((pair) => pairs.has(pair));
      }),
    )
  );
};

/* Puts the errors first whose messages have most of the query, by the rarity of the pairs. */
const rankByMessages = (query, scores) => {
  const asked = pairsOf(query);
  const had = SITE_INDEX.messages.map(([entry, texts]) => {
    const pairs = new Set(texts.flatMap((text) => [...pairsOf(text)]).filter((pair) => asked.has(pair)));
    return [entry, pairs, texts];
  });
  const times = new Map();
  for (const [, pairs] of had) for (const pair of pairs) times.set(pair, (times.get(pair) || 0) + 1);
  const rarity = (pair) => Math.log(1 + had.length / times.get(pair));
  const sumOf = (pairs) => [...pairs].reduce((sum, pair) => sum + rarity(pair), 0);
  for (const [entry, pairs, texts] of had) {
    if (pairs.size < LEAST_PAIRS) continue;
    /* Pairs that are together in one text tell more than the same ones in several. */
    const together = texts.map((text) => sumOf([...pairsOf(text)].filter((pair) => pairs.has(pair))));
    scores.set(entry, Math.max(scores.get(entry) || 0, 3 * NAMED + sumOf(pairs) + Math.max(...together)));
  }
};

const siteSearch = (typed) => {
  const query = withoutNumbers(typed);
  const { pages, titles, entries } = SITE_INDEX;
  const scores = new Map();
  const names = possibleNames(query);
  let others = query;
  const keys = namesOfKeys();
  entries.forEach(([page, , title], entry) => {
    const pattern = nameIn(title);
    for (const name of pattern ? names.filter((name) => pattern.test(name)) : []) {
      scores.set(entry, pages[page] === ERRORS ? 5 * NAMED : NAMED * pageWeight(pages[page]));
      others = others.replaceAll(name, " ");
    }
    const counter = pages[page] === COUNTERS && lastOf(title);
    if (counter && counter.includes("_") && !keys.has(counter) && query.trim().toLowerCase() === counter)
      scores.set(entry, COUNTER_WEIGHT * NAMED);
  });
  /* In a message the words beside the name of a key are those that lead to its code. */
  const named = scores.size > 0;
  rankByWords(wordsOf(others).length >= FEW_WORDS ? others : query, scores);
  if (DEFINITION.test(query))
    for (const [entry, score] of scores)
      if (pages[entries[entry][0]] === GLOSSARY) scores.set(entry, DEFINITION_WEIGHT * score);
  const errors = [...scores].filter(([entry]) => pages[entries[entry][0]] === ERRORS);
  if (named && errors.length && wordsOf(others).length >= MESSAGE_WORDS) {
    const [entry, score] = errors.reduce((one, other) => (other[1] > one[1] ? other : one));
    scores.set(entry, Math.max(score, NAMED / 2));
  }
  const isQuestion = rankByQuestions(others, scores) >= SAME_QUESTION || QUESTION.test(query);
  /* A topic or a path is one name, though it has many words. */
  const isMessage = /\s/.test(query.trim()) && splitQuery(query).length >= MESSAGE_WORDS;
  if (isMessage && (!isQuestion || (!QUESTION.test(query) && isCopied(query)))) rankByMessages(query, scores);
  const best = Math.max(0, ...scores.values());
  const enough = best > NAMED / 4 ? 0 : best * LEAST_SHARE;
  return [...scores]
    .filter(([, score]) => score > enough)
    .sort(([one, a], [other, b]) => b - a || one - other)
    .map(([entry, score]) => {
      const [page, anchor, title, excerpt] = entries[entry];
      const shown = anchor ? `${titles[page]} > ${title}` : title;
      /* Without an excerpt Sphinx would fetch the page, which a browser does not allow of a file. */
      const text = excerpt || titles[page];
      return [pages[page], shown, anchor && `#${anchor}`, text, score, `${pages[page]}.md`, SearchResultKind.text];
    });
};

/* What Sphinx shows below the heading. It counts pages, and would count only what is shown. */
const summaryOf = (count) => {
  if (count === 0) return "Nothing found. Try fewer words, or other ones.";
  if (count === 1) return "1 result.";
  return count > MOST_RESULTS ? `${count} results; the best ${MOST_RESULTS} are shown.` : `${count} results.`;
};

/* Sphinx shows the last one first. */
Search._performSearch = (query) => {
  const found = siteSearch(query);
  Documentation.gettext = Documentation.ngettext = () => summaryOf(found.length);
  return found.slice(0, MOST_RESULTS).reverse();
};

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
