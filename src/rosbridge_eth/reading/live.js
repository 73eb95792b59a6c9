// Draws what `events` sends: each message is all there is to show. What robots wrote becomes text, never markup.
"use strict";

const $ = (selector, within = document) => within.querySelector(selector);
const robots = new Map(); // by name, the article
let state = null;

const link = (text, kind) => {
  if ($("#link").textContent !== text) $("#link").textContent = text; // said aloud where it changes
  $("#link").dataset.state = kind;
};

const source = new EventSource("events");
source.onmessage = (event) => {
  state = JSON.parse(event.data);
  link("Live", "good");
  show();
};
source.onerror = () => {
  link("Nothing comes from the reader: trying again", "bad");
  if (source.readyState === EventSource.CLOSED) setTimeout(() => location.reload(), 5000); // refused, not cut off
};

function show() {
  showChain();
  for (const [name, article] of robots) { // the reader was begun anew, with other robots
    if (state.robots.some((robot) => robot.name === name)) continue;
    article.remove();
    robots.delete(name);
  }
  for (const robot of state.robots) {
    if (!robots.has(robot.name)) {
      const article = $("#robot").content.cloneNode(true).firstElementChild;
      const heading = $("h2", article);
      heading.id = `robot-${robot.name}`;
      article.setAttribute("aria-labelledby", heading.id);
      $(".name", article).textContent = robot.name;
      $("#robots").append(article);
      robots.set(robot.name, article);
    }
    showRobot(robots.get(robot.name), robot);
  }
}

function showChain() {
  const read = state.robots.filter((robot) => robot.block !== undefined).sort((a, b) => b.block - a.block)[0];
  facts($("#chain"), [
    [state.nodes.length > 1 ? "Nodes" : "Node", state.nodes.join(", ")],
    ["Read up to block", read ? `${read.block.toLocaleString("en")}, made ${ago(read.block_s * 1000)}` : "–"],
    ["Confirmations asked for", String(state.confirmations)],
  ]);
}

function showRobot(article, robot) {
  const sound = $(".sound", article), trouble = $(".trouble", article);
  const known = robot.sound !== undefined;
  say(sound, !known ? "not read yet" : robot.sound ? "sound" : "NOT SOUND");
  sound.dataset.state = !known ? "wait" : robot.sound ? "good" : "bad";
  trouble.hidden = !robot.trouble;
  say(trouble, robot.trouble ? `${robot.trouble}. It is asked again; what is shown is from before.` : "");
  showFacts(article, robot);
  draw($("svg", article), robot);
  legend($("figcaption", article), robot.tracks);
  showLatest($(".latest", article), robot.latest);
  const lines = (robot.lines || []).map((line) => line.trim());
  if (lines.join() !== $(".verdict ul", article).dataset.lines) {
    $(".verdict ul", article).replaceChildren(...lines.map((line) => made("li", line)));
    $(".verdict ul", article).dataset.lines = lines.join();
  }
  if (known && !robot.sound && !article.dataset.told) {
    $(".verdict", article).open = true;
    article.dataset.told = "1";
  }
}

function showFacts(article, robot) {
  const sealed = robot.sealed_ms;
  const silent = sealed && !robot.goodbye && Date.now() - sealed > robot.silent_s * 1000;
  facts($(".facts", article), robot.block === undefined ? [] : [
    ["Chunks on the chain", robot.chunks.toLocaleString("en")],
    ["Records proven", robot.records.toLocaleString("en")],
    ["Last sealed, by the robot's clock", sealed ? `${clock(sealed)}, ${ago(sealed)}` : "never"],
    ["The robot", !sealed ? "has written nothing" : robot.goodbye ? "has said goodbye"
      : silent ? "is silent, or withheld" : "goes on"],
  ]);
}

// Facts and values change in place, so that focus, selection and a screen reader's place stay.

function facts(list, pairs) {
  while (list.children.length > pairs.length) list.lastElementChild.remove();
  pairs.forEach(([name, value], at) => {
    let pair = list.children[at];
    if (!pair) {
      pair = document.createElement("div");
      pair.append(made("dt", ""), made("dd", ""));
      list.append(pair);
    }
    say(pair.firstElementChild, name);
    say(pair.lastElementChild, value);
  });
}

function showLatest(section, topics) {
  const there = new Map([...section.querySelectorAll("details")].map((one) => [one.dataset.topic, one]));
  for (const [name, details] of there) if (!topics.some((topic) => topic.topic === name)) details.remove();
  for (const topic of topics) {
    let details = there.get(topic.topic);
    if (!details) {
      details = $("#topic").content.cloneNode(true).firstElementChild;
      details.dataset.topic = topic.topic;
      details.open = there.size === 0 && topic === topics[0];
      $(".name", details).textContent = topic.topic;
      section.append(details);
    }
    say($(".about", details), `${topic.type}, received ${topic.received}, proven in chunk ${topic.chunk}, block ${topic.block}`);
    const rows = [...topic.fields, ...(topic.more ? [[`and ${topic.more} fields more`, ""]] : [])];
    const body = $("tbody", details);
    while (body.rows.length > rows.length) body.lastElementChild.remove();
    rows.forEach(([name, value], at) => {
      let row = body.rows[at];
      if (!row) {
        row = body.insertRow();
        const head = made("th", "");
        head.scope = "row";
        row.append(head, made("td", ""));
      }
      say(row.cells[0], name);
      if (say(row.cells[1], value)) {
        row.cells[1].classList.remove("new");
        void row.cells[1].offsetWidth; // begins the animation anew
        row.cells[1].classList.add("new");
      }
    });
  }
  section.hidden = !topics.length;
}

// The trajectory: x to the right, y up, one scale for both.

const SVG = "http://www.w3.org/2000/svg";

function draw(svg, robot) {
  const width = svg.clientWidth, height = svg.clientHeight, tracks = robot.tracks;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const where = tracks.map((track) => {
    const [x, y] = track.points.at(-1);
    return `${track.topic}: ${track.count} positions, now at x ${short(x)} m, y ${short(y)} m`;
  });
  svg.setAttribute("aria-label", `Trajectory of ${robot.name}. ${where.join("; ") || "No positions yet."}`);
  if (!tracks.length) {
    svg.replaceChildren(shape("text", { x: width / 2, y: height / 2, "text-anchor": "middle" }, "no positions yet"));
    return;
  }
  const all = tracks.flatMap((track) => track.points);
  let [left, right] = range(all.map(([x]) => x)), [low, high] = range(all.map(([, y]) => y));
  const margin = 36, scale = Math.min((width - 2 * margin) / (right - left), (height - 2 * margin) / (high - low));
  const X = (x) => width / 2 + (x - (left + right) / 2) * scale, Y = (y) => height / 2 - (y - (low + high) / 2) * scale;
  const step = nice(70 / scale), parts = [], labels = [];
  for (let n = Math.ceil((left - width / scale) / step); n * step <= right + width / scale; n++) {
    const x = X(n * step);
    if (x < 0 || x > width) continue;
    parts.push(shape("line", { class: n ? "grid" : "axis", x1: x, x2: x, y1: 0, y2: height }));
    if (x > 40 && x < width - 64) labels.push(shape("text", { x, y: height - 6, "text-anchor": "middle" }, short(n * step, 12)));
  }
  for (let n = Math.ceil((low - height / scale) / step); n * step <= high + height / scale; n++) {
    const y = Y(n * step);
    if (y < 0 || y > height) continue;
    parts.push(shape("line", { class: n ? "grid" : "axis", x1: 0, x2: width, y1: y, y2: y }));
    if (y > 20 && y < height - 26) labels.push(shape("text", { x: 6, y: y - 4 }, short(n * step, 12)));
  }
  labels.push(shape("text", { x: width - 6, y: height - 6, "text-anchor": "end" }, "x in m"));
  labels.push(shape("text", { x: 6, y: 14 }, "y in m"));
  parts.push(...labels);
  tracks.forEach((track, at) => {
    const colour = `t${at % 6}`, [x0, y0] = track.points[0];
    const points = track.points.map(([x, y]) => `${X(x).toFixed(1)},${Y(y).toFixed(1)}`).join(" ");
    parts.push(shape("polyline", { class: colour, points }));
    parts.push(shape("circle", { class: `start ${colour}`, cx: X(x0), cy: Y(y0), r: 4 }));
  });
  // The robots themselves stay, so that they move from where they were.
  const nows = [...svg.querySelectorAll(".now")];
  tracks.forEach((track, at) => {
    const [x, y] = track.points.at(-1), dot = nows[at] || shape("circle", { class: `now t${at % 6}`, r: 6 });
    dot.style.transform = `translate(${X(x)}px, ${Y(y)}px)`;
    nows[at] = dot;
  });
  for (const old of [...svg.children]) if (!nows.includes(old)) old.remove();
  svg.prepend(...parts);
  for (const dot of nows) if (!dot.parentNode) svg.append(dot);
}

function legend(caption, tracks) {
  caption.replaceChildren(...tracks.map((track, at) => {
    const seconds = Number(BigInt(track.to_ns) - BigInt(track.from_ns)) / 1e9;
    const sample = shape("svg", { "aria-hidden": "true", viewBox: "0 0 24 10" });
    sample.append(shape("line", { class: `t${at % 6}`, x1: 1, x2: 23, y1: 5, y2: 5, "stroke-width": 3 }));
    const row = made("span", "");
    row.append(sample, made("span", `${track.topic}: ${track.count.toLocaleString("en")} positions in ${seconds.toFixed(1)} s`));
    return row;
  }));
}

// Small things

function say(node, text) {
  if (node.textContent === text) return false;
  const before = node.textContent;
  node.textContent = text;
  return before !== "";
}

function made(tag, text) {
  const node = document.createElement(tag);
  node.textContent = text;
  return node;
}

function shape(tag, attributes, text = "") {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text) node.textContent = text;
  return node;
}

function range(values) { // at least a metre, so that a robot that stands does not fill the picture with its noise
  let least = Infinity, most = -Infinity;
  for (const value of values) {
    least = Math.min(least, value);
    most = Math.max(most, value);
  }
  const wanting = Math.max(0, 1 - (most - least)) / 2;
  return [least - wanting, most + wanting];
}

function nice(least) { // 1, 2 or 5 times a power of ten
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((times) => times * power >= least);
}

const short = (number, digits = 4) => String(Number(number.toPrecision(digits)));
const clock = (ms) => new Date(ms).toISOString().slice(0, 19).replace("T", " ") + "Z";

function ago(ms) {
  const seconds = Math.max(0, Math.round((Date.now() - ms) / 1000));
  if (seconds < 100) return `${seconds} s ago`;
  if (seconds < 6000) return `${Math.round(seconds / 60)} min ago`;
  if (seconds < 360000) return `${Math.round(seconds / 3600)} h ago`;
  return `${Math.round(seconds / 86400)} days ago`;
}

setInterval(() => { // what is said of the time that has passed
  if (!state) return;
  showChain();
  for (const robot of state.robots) if (robots.has(robot.name)) showFacts(robots.get(robot.name), robot);
}, 1000);
addEventListener("resize", () => state && show());
