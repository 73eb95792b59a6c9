// Draws what `events` sends: each message is all there is to show.
'use strict'

const $ = (selector) => document.querySelector(selector)
const unfolded = new Set() // robots whose findings were unfolded
let state = null

const link = (text, kind) => {
  if ($('#link').textContent !== text) $('#link').textContent = text // said aloud where it changes
  $('#link').dataset.state = kind
}

const source = new EventSource('events')
source.onmessage = ({ data }) => {
  state = JSON.parse(data)
  link('Live', 'good')
  show()
}
source.onerror = () => {
  link('Nothing comes from the reader: trying again', 'bad')
  if (source.readyState === EventSource.CLOSED) setTimeout(() => location.reload(), 5000) // refused, not cut off
}
setInterval(() => state && show(), 1000) // what is said of the time that has passed

function show() {
  const read = state.robots.filter(({ block }) => block !== undefined).sort((a, b) => b.block - a.block)[0]
  update($('#chain'), facts({ id: 'chain', 'aria-label': 'The chain' }, [
    [state.nodes.length > 1 ? 'Nodes' : 'Node', state.nodes.join(', ')],
    ['Read up to block', read ? `${read.block.toLocaleString('en')}, made ${ago(read.block_s * 1000)}` : '–'],
    ['Confirmations asked for', String(state.confirmations)],
  ]))
  update($('#robots'), make('main', { id: 'robots' }, ...state.robots.map(articleOf)))
  state.robots.forEach(({ name, sound }, n) => {
    if (sound !== false || unfolded.has(name)) return
    $('#robots').children[n].querySelector('.verdict').open = true
    unfolded.add(name)
  })
}

// Makes a node like another one. What is alike stays, with its focus, its selection and what is unfolded.
function update(node, other) {
  if (node.nodeName !== other.nodeName || node.dataset.key !== other.dataset.key) return node.replaceWith(other)
  for (const { name } of [...node.attributes]) if (name !== 'open' && !other.hasAttribute(name)) node.removeAttribute(name)
  for (const { name, value } of other.attributes) {
    if (name !== 'open' && node.getAttribute(name) !== value) node.setAttribute(name, value)
  }
  if (!node.children.length || !other.children.length) {
    if (other.children.length || node.textContent !== other.textContent) node.replaceChildren(...other.childNodes)
    return
  }
  const parts = [...other.children]
  parts.forEach((part, n) => (node.children[n] ? update(node.children[n], part) : node.append(part)))
  while (node.children.length > parts.length) node.lastElementChild.remove()
}

const facts = (attributes, pairs) => make('dl', attributes, ...pairs.map(
  ([name, value]) => make('div', {}, make('dt', {}, name), make('dd', {}, value))))
const hidden = (isHidden) => (isHidden ? { hidden: '' } : {})

function articleOf(robot) {
  const { name, sound, trouble, tracks, latest } = robot
  const [kind, said] = sound === undefined ? ['wait', 'not read yet'] : sound ? ['good', 'sound'] : ['bad', 'NOT SOUND']
  const where = tracks.map(({ topic, count, points }) => {
    const [x, y] = points.at(-1)
    return `${topic}: ${count} positions, now at x ${short(x)} m, y ${short(y)} m`
  })
  return make('article', { 'data-key': name, 'aria-labelledby': `robot-${name}` },
    make('h2', { id: `robot-${name}` },
      make('span', { class: 'name' }, name), make('span', { class: 'sound', 'data-state': kind }, said)),
    make('p', { class: 'trouble', role: 'alert', ...hidden(!trouble) },
      trouble ? `${trouble}. It is asked again; what is shown is from before.` : ''),
    facts({ class: 'facts' }, sound === undefined ? [] : factsOf(robot)),
    make('div', { class: 'sides' },
      make('figure', {},
        picture(tracks.map(({ points }) => points), `Trajectory of ${name}. ${where.join('; ') || 'No positions yet.'}`),
        make('figcaption', {}, ...tracks.map(legendOf))),
      make('section', { class: 'latest', ...hidden(!latest.length) }, make('h3', {}, 'Latest values'), ...latest.map(valuesOf))),
    make('details', { class: 'verdict' }, make('summary', {}, 'Verdict'),
      make('ul', {}, ...(robot.lines ?? []).map((line) => make('li', {}, line.trim())))))
}

function factsOf({ chunks, records, sealed_ms: sealed, goodbye, silent_s: silent }) {
  return [
    ['Chunks on the chain', chunks.toLocaleString('en')],
    ['Records proven', records.toLocaleString('en')],
    ["Last sealed, by the robot's clock",
      sealed ? `${new Date(sealed).toISOString().slice(0, 19).replace('T', ' ')}Z, ${ago(sealed)}` : 'never'],
    ['The robot', !sealed ? 'has written nothing' : goodbye ? 'has said goodbye'
      : Date.now() - sealed > silent * 1000 ? 'is silent, or withheld' : 'goes on'],
  ]
}

function legendOf({ topic, count, from_ns: from, to_ns: to }, n) {
  const seconds = Number(BigInt(to) - BigInt(from)) / 1e9
  return make('span', { class: `t${n % 6}` }, `${topic}: ${count.toLocaleString('en')} positions in ${seconds.toFixed(1)} s`)
}

function valuesOf({ topic, type, received, chunk, block, fields, more }, n) {
  const rows = [...fields, ...(more ? [[`and ${more} fields more`, '']] : [])]
  return make('details', { 'data-key': topic, ...(n ? {} : { open: '' }) },
    make('summary', {}, topic),
    make('p', { class: 'about' }, `${type}, received ${received}, proven in chunk ${chunk}, block ${block}`),
    make('div', { class: 'wide' }, make('table', {}, make('tbody', {}, ...rows.map(
      ([name, value]) => make('tr', {}, make('th', { scope: 'row' }, name), make('td', {}, value)))))))
}

function ago(ms) {
  const seconds = Math.max(0, Math.round((Date.now() - ms) / 1000))
  const [each, unit] = [[1, 's'], [60, 'min'], [3600, 'h'], [86400, 'days']].findLast(([each]) => seconds >= 1.6 * each) ?? [1, 's']
  return `${Math.round(seconds / each)} ${unit} ago`
}
