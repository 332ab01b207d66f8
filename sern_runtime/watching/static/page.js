"use strict";
// Draws what /api/live tells. Whatever came over the network is put into the page as text, never as markup; the server's
// Content-Security-Policy and trusted types keep it so.

const LINKS_SHOWN = 12;
const TOPICS_SHOWN = 40;
const POINTS = 120;
const HEARD_S = 3; // who was heard within this was heard just now
const STALE_MS = 3500;
const HIDDEN_MS = 30000;
const LINGER_MS = 10000; // so long a topic stays where it was put when it was in trouble
const RETRY_MS = [1000, 2000, 4000, 8000];
const TOKEN = "sern-token";
const SVG = "http://www.w3.org/2000/svg";
const WORST = { bad: 0, warn: 1, ok: 2, note: 3 };
const CLASSES = ["control", "state", "bulk"];
const UNREADABLE = /[\p{Cc}\p{Cf}\p{Cs}\p{Co}\p{Zl}\p{Zp}]/gu; // what steers or hides text, such as a change of direction

const at = (id) => document.getElementById(id);
const shown = { links: false, topics: false, filter: "" };
let state = null;
let heardMs = performance.now();
let problem = "";

// --- words and numbers ------------------------------------------------------------------------------------------------

const plain = (text) => String(text).replace(UNREADABLE, "\ufffd");

/** A number in at most five characters, powers of 1000; empty for none. */
function count(value) {
  if (value === null || value < 0.05) return "";
  if (value < 99.95) return value.toFixed(1);
  for (const unit of ["", "k", "M", "G"]) {
    if (value < 999.5 || unit === "G") return (value >= 9.95 || !unit ? value.toFixed(0) : value.toFixed(1)) + unit;
    value /= 1000;
  }
  return "";
}

/** A number of bytes. */
function bytes(value) {
  const [, number, unit] = /^([0-9.]*)(.*)$/.exec(count(value));
  return `${number || 0} ${unit}B`;
}

/** A time span in at most five characters. */
function ago(seconds) {
  if (seconds === null) return "";
  if (seconds < 9.95) return `${Math.max(0, seconds).toFixed(1)} s`;
  if (seconds < 100) return `${seconds.toFixed(0)} s`;
  if (seconds < 6000) return `${(seconds / 60).toFixed(0)} min`;
  return seconds < 360000 ? `${(seconds / 3600).toFixed(0)} h` : `${(seconds / 86400).toFixed(0)} d`;
}

/** A rate out of kbit/s. */
function rate(kbps) {
  if (kbps === null) return "–";
  if (kbps < 0.05) return "0";
  if (kbps < 1000) return `${kbps.toFixed(kbps < 10 ? 1 : 0)} kbit/s`;
  return `${(kbps / 1000).toFixed(kbps < 100000 ? 1 : 0)} Mbit/s`;
}

/** The same in few characters. */
const short = (kbps) => (kbps === null ? "–" : count(1e3 * kbps) || "0");

const whole = (value) => value.toLocaleString("en");
const percent = (permille) => (permille ? `${(permille / 10).toFixed(permille < 100 ? 1 : 0)} %` : "0 %");

// --- elements ---------------------------------------------------------------------------------------------------------

function make(tag, name = "", ...children) {
  const element = document.createElement(tag);
  if (name) element.className = name;
  element.append(...children);
  return element;
}

function text(element, value) {
  const readable = plain(value);
  if (element.textContent !== readable) element.textContent = readable;
}

function style(element, name) {
  if (element.className !== name) element.className = name;
}

/** Keeps one element for each key, in the order of the rows. `create()` makes what `update(parts, row)` fills. */
class List {
  #box;
  #create;
  #update;
  #parts = new Map();

  constructor(box, create, update) {
    this.#box = box;
    this.#create = create;
    this.#update = update;
  }

  show(rows, key) {
    const seen = new Set();
    let place = this.#box.firstElementChild;
    for (const row of rows) {
      const name = key(row);
      if (seen.has(name)) continue;
      seen.add(name);
      let parts = this.#parts.get(name);
      if (!parts) {
        parts = this.#create();
        this.#parts.set(name, parts);
      }
      this.#update(parts, row);
      if (parts.root === place) place = place.nextElementSibling;
      else this.#box.insertBefore(parts.root, place);
    }
    for (const [name, parts] of this.#parts) {
      if (!seen.has(name)) {
        parts.root.remove();
        this.#parts.delete(name);
      }
    }
  }
}

// --- pictures ---------------------------------------------------------------------------------------------------------

const WIDTH = 240;
const HEIGHT = 30;
const history = { number: 0, stepS: 5, links: new Map() };

/** A small picture of the last ten minutes, with what is now and the highest of it in words. */
class Picture {
  constructor(label) {
    this.label = make("span", "", label);
    this.value = make("b");
    this.svg = document.createElementNS(SVG, "svg");
    this.svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
    this.svg.setAttribute("preserveAspectRatio", "none");
    this.svg.setAttribute("role", "img");
    this.title = document.createElementNS(SVG, "title");
    this.svg.append(this.title);
    this.shapes = new Map();
    this.root = make("div", "picture", make("div", "label", this.label, this.value), this.svg);
  }

  shape(tag, name) {
    let shape = this.shapes.get(name);
    if (!shape) {
      shape = document.createElementNS(SVG, tag);
      shape.setAttribute("class", name);
      this.shapes.set(name, shape);
      this.svg.append(shape);
    }
    return shape;
  }

  /** Paths of one value of the points, up to `top`; a gap where it is not known. */
  draw(points, index, top, name, area = false) {
    const x = (number) => (WIDTH * (number - history.number + POINTS - 1)) / (POINTS - 1);
    const y = (value) => HEIGHT - 1 - ((HEIGHT - 3) * Math.min(value, top)) / top;
    let line = "";
    let filled = "";
    let last = null;
    for (const point of points) {
      const value = point[index];
      if (value === null) {
        last = null;
        continue;
      }
      const place = `${x(point[0]).toFixed(1)} ${y(value).toFixed(1)}`;
      const joined = last !== null && point[0] === last + 1;
      if (!joined && filled) filled += `V${HEIGHT}Z`;
      line += `${joined ? "L" : "M"}${place}`;
      if (!joined) line += "h0.01"; // a point alone is seen
      filled += joined ? `L${place}` : `M${x(point[0]).toFixed(1)} ${HEIGHT}L${place}`;
      last = point[0];
    }
    if (area) this.shape("path", "area").setAttribute("d", filled ? `${filled}V${HEIGHT}Z` : "");
    this.shape("path", name).setAttribute("d", line);
  }

  /** Where the link was down. */
  down(points) {
    const step = WIDTH / (POINTS - 1);
    const parts = points
      .filter((point) => !point[1])
      .map((point) => `M${((point[0] - history.number + POINTS - 1) * step - step / 2).toFixed(1)} 0h${step.toFixed(1)}V${HEIGHT}h-${step.toFixed(1)}Z`);
    this.shape("path", "down").setAttribute("d", parts.join(""));
  }

  say(value, title) {
    text(this.value, value);
    text(this.title, title);
  }
}

const newest = (points, index) => points.reduce((last, point) => (point[index] === null ? last : point[index]), null);
const highest = (points, index) => points.reduce((top, point) => Math.max(top, point[index] ?? 0), 0);

function drawLink(parts, peer) {
  const points = history.links.get(peer);
  parts.pictures.hidden = !points;
  if (!points || parts.drawn === history.number) return;
  parts.drawn = history.number;
  const { traffic, trip, loss } = parts;
  for (const picture of [traffic, trip, loss]) picture.down(points);
  const carries = newest(points, 2);
  const sent = newest(points, 3);
  const came = newest(points, 4);
  const top = Math.max(highest(points, 2), highest(points, 3), highest(points, 4), 1);
  const mostlySent = highest(points, 3) >= highest(points, 4);
  traffic.draw(points, 3, top, "line", mostlySent);
  traffic.draw(points, 4, top, "line second", !mostlySent);
  traffic.draw(points, 2, top, "limit");
  text(traffic.sent, carries === null ? short(sent) : `${short(sent)} of ${short(carries)}`);
  text(traffic.came, `${short(came)} bit/s`);
  traffic.say(
    "",
    `sent ${rate(sent)}, received ${rate(came)}, carries ${carries === null ? "more than was ever asked of it" : rate(carries)}`,
  );
  const ms = newest(points, 5);
  trip.draw(points, 5, Math.max(highest(points, 5), 1), "line", true);
  trip.say(ms === null ? "–" : `${ms.toFixed(0)} ms`, `round trip, at most ${highest(points, 5).toFixed(0)} ms in ten minutes`);
  loss.draw(points, 6, Math.max(highest(points, 6), 50), "line", true);
  loss.say(percent(newest(points, 6) ?? 0), `packets lost, at most ${percent(highest(points, 6))} in ten minutes`);
}

function learnLinks(told) {
  history.number = told.number;
  history.stepS = told.step_s;
  for (const [peer, fresh] of told.links) {
    const known = history.links.get(peer) ?? [];
    const last = known.length ? known[known.length - 1][0] : -1;
    history.links.set(peer, known.concat(fresh.filter((point) => point[0] > last)));
  }
  for (const [peer, points] of history.links) {
    const kept = points.filter((point) => point[0] > told.number - POINTS);
    if (kept.length) history.links.set(peer, kept);
    else history.links.delete(peer);
  }
}

// --- sections ---------------------------------------------------------------------------------------------------------

const STATES = {
  connected: ["good", ""], silent: ["bad", "does not answer"], away: ["bad", "gone"], unknown: ["warn", "unknown"],
  forgotten: ["note", "gone"], never: ["note", "never came"],
};

const links = new List(
  at("links"),
  () => {
    const parts = { name: make("b"), state: make("span"), heard: make("span", "heard"), why: make("div", "link-why") };
    parts.traffic = new Picture("");
    parts.traffic.sent = make("span");
    parts.traffic.came = make("span");
    parts.traffic.label.append(make("i", "key out", "to "), parts.traffic.sent, " ", make("i", "key in", "from "), parts.traffic.came);
    parts.trip = new Picture("RTT");
    parts.loss = new Picture("loss");
    parts.pictures = make("div", "pictures", parts.traffic.root, parts.trip.root, parts.loss.root);
    parts.root = make("li", "", make("div", "link-head", parts.name, parts.state, parts.heard), parts.why, parts.pictures);
    return parts;
  },
  (parts, row) => {
    const [level, word] = STATES[row.state] ?? ["note", row.state];
    text(parts.name, row.peer);
    style(parts.state, `state mark ${level}`);
    const since = row.since_s === null ? "" : ` for ${ago(row.since_s)}`;
    const lane = row.lane ? ` · ${row.lane === "zmq" ? "TCP" : row.lane}` : "";
    const trip = row.round_trip_s === null || history.links.has(row.peer) ? "" : ` · RTT ${(1e3 * row.round_trip_s).toFixed(0)} ms`;
    text(parts.state, row.state === "connected" ? `connected${since}${lane}${trip}` : `${word}${row.state === "never" ? "" : since}`);
    text(parts.heard, row.state === "never" || row.heard_s === null || row.heard_s < HEARD_S ? "" : `heard ${ago(row.heard_s)} ago`);
    text(parts.why, row.why);
    parts.why.hidden = !row.why;
    drawLink(parts, row.peer);
  },
);

const topics = new List(
  at("topics"),
  () => {
    const parts = { name: make("span"), label: make("small"), hz: make("span"), bytes: make("span"), age: make("span"), drops: make("span") };
    parts.why = make("div", "why");
    parts.reasons = make("div", "drops");
    const row = make("div", "row", make("span", "topic", parts.name, parts.label), parts.hz, parts.bytes, parts.age, parts.drops);
    parts.root = make("li", "", row, parts.why, parts.reasons);
    return parts;
  },
  (parts, row) => {
    text(parts.name, row.topic);
    text(parts.label, row.priority === "?" ? "" : row.priority);
    text(parts.hz, count(row.hz) || "–");
    text(parts.bytes, count(row.bytes_per_s) || "–");
    text(parts.age, ago(row.age_s) || "–");
    text(parts.drops, count(row.drops_hz) || "–");
    style(parts.drops, row.drops_hz ? "warn" : "");
    text(parts.why, row.why);
    style(parts.why, `why ${row.why ? "mark " : ""}${row.level}`);
    parts.why.hidden = !row.why;
    const reasons = Object.entries(row.reasons).map(([reason, number]) => `${reason} ${whole(number)}`);
    text(parts.reasons, reasons.length ? `${whole(row.messages)} came through, ${whole(row.drops)} dropped: ${reasons.join(", ")}` : "");
    parts.reasons.hidden = !reasons.length;
  },
);

const alerts = new List(
  at("alerts"),
  () => {
    const parts = { text: make("b"), about: make("span", "about") };
    parts.root = make("li", "", parts.text, parts.about);
    return parts;
  },
  (parts, row) => {
    style(parts.root, row.level);
    text(parts.text, row.text);
    const more = row.count - row.topics.length;
    const own = row.count === 1 && row.text.startsWith(row.topics[0]); // the text names it
    text(parts.about, row.topics.join(", ") + (more > 0 ? ` and ${more} more` : ""));
    parts.about.hidden = !row.count || own;
  },
);

const simple = (fill) => [() => ({ root: make("li") }), (parts, row) => fill(parts.root, row)];
const objects = new List(at("objects"), ...simple((root, [kind, number]) => text(root, `${kind} ${whole(number)}`)));
const choices = new List(
  at("choices"),
  ...simple((root, row) => {
    style(root, row.text.includes("let in: ") ? "warn" : "");
    text(root, `${row.peer}: ${row.text}${row.reason ? ` (${row.reason})` : ""}`);
  }),
);
const events = new List(
  at("events"),
  () => {
    const parts = { time: make("time"), text: make("span") };
    parts.root = make("li", "", parts.time, parts.text);
    return parts;
  },
  (parts, row) => {
    text(parts.time, `${row.time.slice(11, 19)}Z`);
    text(parts.text, row.text);
  },
);
const classes = new Map(
  CLASSES.map((label) => {
    const parts = { flow: make("span"), drops: make("span") };
    at("classes").append(make("div", "", make("b", "", label), parts.flow, parts.drops));
    return [label, parts];
  }),
);

function showAlerts() {
  const healthy = { level: "good", key: "well", text: "Nothing is wrong.", topics: [], count: 0 };
  alerts.show(state.alerts.length ? state.alerts : [healthy], (row) => row.key);
}

function showLinks() {
  const rows = [...state.links, ...state.peers];
  const known = state.role === "relay" ? rows.filter((row) => row.state !== "never" && row.state !== "forgotten") : rows;
  const first = shown.links ? rows : known.slice(0, LINKS_SHOWN);
  text(at("fleet-title"), state.role === "relay" ? "Robots and sites" : "Link and peers");
  const strangers = state.links_total - state.links_known;
  text(at("fleet-count"), state.role === "relay" ? `${state.links_up} of ${state.links_known} connected${strangers > 0 ? `, ${strangers} not here` : ""} · last 10 min` : "last 10 min");
  links.show(first, (row) => row.peer);
  const hidden = rows.length - first.length;
  at("links-more").hidden = !hidden && !shown.links;
  text(at("links-more"), shown.links ? "show fewer" : `show ${hidden} more`);
}

const troubled = new Map(); // topic: its worst level lately, and when it was at that

/** By which a topic is placed: its level, or a worse one of the last seconds, so that rows do not jump. */
function placed(row) {
  const now = performance.now();
  const known = troubled.get(row.topic);
  if (known && now - known.at < LINGER_MS && WORST[known.level] < WORST[row.level]) return WORST[known.level];
  if (row.elsewhere) return WORST.ok + 0.5; // an alert says it of all of them
  if (row.level === "bad" || row.level === "warn") troubled.set(row.topic, { level: row.level, at: now });
  else troubled.delete(row.topic);
  return WORST[row.level];
}

function showTopics() {
  const order = (label) => CLASSES.indexOf(label);
  const asked = shown.filter.toLowerCase();
  const rows = state.topics
    .map((row) => [placed(row), order(row.priority), row])
    .sort((a, b) => a[0] - b[0] || a[1] - b[1] || (a[2].topic < b[2].topic ? -1 : 1))
    .map((each) => each[2])
    .filter((row) => !asked || `${row.topic} ${row.priority} ${row.why}`.toLowerCase().includes(asked));
  for (const name of troubled.keys()) if (performance.now() - troubled.get(name).at >= LINGER_MS) troubled.delete(name);
  const first = shown.topics || asked ? rows : rows.slice(0, TOPICS_SHOWN);
  topics.show(first, (row) => row.topic);
  const untold = state.topics_total - state.topics.length;
  text(at("topics-count"), `${whole(state.topics_total)}${state.topics_wrong ? `, ${whole(state.topics_wrong)} in trouble` : ""}`);
  const hidden = rows.length - first.length;
  at("topics-more").hidden = !hidden && !(shown.topics && rows.length > TOPICS_SHOWN);
  text(at("topics-more"), hidden ? `show ${hidden} more` : "show fewer");
  const none = !state.topics_total ? "Nothing is published here yet." : asked && !first.length ? "No topic is like that." : untold > 0 && (shown.topics || asked) ? `${whole(untold)} more are not told: those that fare well.` : "";
  text(at("topics-none"), none);
  at("topics-none").hidden = !none;
  for (const [label, parts] of classes) {
    const row = state.classes[label];
    text(parts.flow, row.topics ? `${count(row.hz) || 0} Hz, ${bytes(row.bytes_per_s)}/s` : "none");
    text(parts.drops, row.topics ? (row.drops_hz ? `${count(row.drops_hz) || "few"} dropped/s` : `${row.topics} topics`) : "");
    style(parts.drops, row.drops_hz ? "warn" : "dim");
  }
}

function showRest() {
  const about = state.adaptation;
  text(at("choice-about"), about ? `${about.policy}, ${about.profile}, each ${about.interval_s} s` : "");
  const thin = state.choices.filter((row) => row.text.includes("let in: ") || row.text.includes("summaries: "));
  const told = state.choices.length > 1 ? thin : state.choices;
  choices.show(told, (row) => row.peer);
  const none = !about ? "None: everything goes as the rules of the topics say." : told.length ? "" : state.choices.length ? `All ${state.choices_total} links: everything is let in.` : "No link yet.";
  text(at("choices-none"), none);
  at("choices-none").hidden = !none;
  const kinds = Object.entries(state.objects).sort();
  text(at("objects-count"), whole(kinds.reduce((sum, [, number]) => sum + number, 0)));
  objects.show(kinds, ([kind]) => kind);
  events.show([...state.events].reverse(), (row) => String(row.number));
}

/** The first line: how it is, in words, or that nothing is known. */
function showVerdict() {
  const bar = at("bar");
  const silentMs = performance.now() - heardMs;
  if (!state || silentMs > STALE_MS || problem) {
    style(bar, state ? "bad" : "wait");
    const before = state ? ` – what follows is of ${state.time.slice(11, 19)}Z` : "";
    text(at("verdict"), problem || silentMs > STALE_MS ? `${problem || "No answer"}${state ? ` for ${ago(silentMs / 1000)}` : ""}${before}` : "asking the daemon");
    document.title = "– SERN";
    return;
  }
  const [first, ...more] = state.alerts;
  style(bar, first ? first.level : "good");
  const others = state.alerts_total - 1;
  const up = state.role === "relay" ? `All is well: ${state.links_up} of ${state.links_known} connected` : "All is well: connected";
  const empty = state.role === "relay" && !state.links_known ? "Nobody is connected yet" : up;
  const what = first ? (first.key.startsWith("link ") ? first.text.split(": ")[0] : first.text) : empty; // a phone is narrow
  text(at("verdict"), `${what}${first && others > 0 ? `; ${others} more` : ""}`);
  text(at("name"), state.name);
  text(at("role"), state.role);
  text(at("clock"), `${state.time.slice(11, 19)}Z`);
  document.title = `${state.alerts_total ? `(${state.alerts_total}) ` : ""}${plain(state.name)} – SERN`;
}

function show() {
  if (!state) return;
  at("all").hidden = false;
  showAlerts();
  showLinks();
  showTopics();
  showRest();
  showVerdict();
}

// --- what comes in ----------------------------------------------------------------------------------------------------

function take(name, data) {
  if (name === "links") learnLinks(JSON.parse(data));
  if (name !== "state") return;
  state = JSON.parse(data);
  heardMs = performance.now();
  problem = "";
  show();
}

class DeniedError extends Error {}

/** Reads events until the connection ends. A header carries the token: an address would be in logs and histories. */
async function follow(signal) {
  const token = sessionStorage.getItem(TOKEN);
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  const answer = await fetch("/api/live", { headers, signal, cache: "no-store", credentials: "omit", redirect: "error" });
  if (answer.status === 401) throw new DeniedError(token ? "This is not the token." : "");
  if (!answer.ok) throw new Error((await answer.text()).trim().slice(0, 200) || `status ${answer.status}`);
  at("ask").hidden = true;
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let waiting = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    waiting += value;
    const parts = waiting.split("\n\n");
    waiting = parts.pop();
    for (const part of parts) {
      const [, name, data] = /^event: (\w+)\ndata: (.*)$/s.exec(part) ?? [];
      if (name) take(name, data);
    }
  }
}

function askForToken(why) {
  sessionStorage.removeItem(TOKEN);
  text(at("denied"), why);
  at("ask").hidden = false;
  at("all").hidden = true;
  state = null;
  problem = "A token is needed";
  showVerdict();
  at("token").value = "";
  at("token").focus();
  return new Promise((resolve) => {
    at("ask").onsubmit = (event) => {
      event.preventDefault();
      sessionStorage.setItem(TOKEN, at("token").value.trim());
      problem = "";
      resolve();
    };
  });
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
const inSight = () =>
  new Promise((resolve) => {
    if (!document.hidden) resolve();
    else document.addEventListener("visibilitychange", resolve, { once: true });
  });

async function main() {
  let failures = 0;
  for (;;) {
    await inSight(); // nobody looks: nothing is sent over what may be a thin link
    const ending = new AbortController();
    let timer = 0;
    const hide = () => {
      clearTimeout(timer);
      if (document.hidden) timer = setTimeout(() => ending.abort(), HIDDEN_MS);
    };
    document.addEventListener("visibilitychange", hide);
    const before = heardMs;
    try {
      await follow(ending.signal);
    } catch (error) {
      if (error instanceof DeniedError) {
        await askForToken(error.message);
        continue;
      }
      if (!ending.signal.aborted) problem = error instanceof TypeError ? "No answer" : error.message;
    } finally {
      clearTimeout(timer);
      document.removeEventListener("visibilitychange", hide);
    }
    failures = heardMs > before ? 0 : failures + 1;
    showVerdict();
    await pause(RETRY_MS[Math.min(failures, RETRY_MS.length - 1)]);
  }
}

at("links-more").onclick = () => {
  shown.links = !shown.links;
  showLinks();
};
at("topics-more").onclick = () => {
  shown.topics = !shown.topics;
  showTopics();
};
at("filter").oninput = (event) => {
  shown.filter = event.target.value.trim();
  if (state) showTopics();
};
setInterval(showVerdict, 1000);
main();
