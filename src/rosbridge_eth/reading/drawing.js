// What the live page and the page of evidence are drawn with. What robots wrote becomes text, never markup.
'use strict'

const SHAPES = new Set(['svg', 'line', 'text', 'polyline', 'circle'])
function make(tag, attributes, ...children) {
  const node = SHAPES.has(tag) ? document.createElementNS('http://www.w3.org/2000/svg', tag) : document.createElement(tag)
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value)
  node.append(...children)
  return node
}

const short = (number, digits = 4) => String(Number(number.toPrecision(digits)))

// Where robots were, from above: x to the right, y up, one scale for both. tracks: of each topic its points, in metres.
function picture(tracks, label) {
  const [width, height, edge] = [720, 440, 44]
  const svg = make('svg', { viewBox: `0 0 ${width} ${height}`, role: 'img', 'aria-label': label })
  const points = tracks.flat()
  if (!points.length) {
    svg.append(make('text', { x: width / 2, y: height / 2, 'text-anchor': 'middle' }, 'no positions yet'))
    return svg
  }
  const ends = [0, 1].map((axis) => points.reduce(
    ([least, most], point) => [Math.min(least, point[axis]), Math.max(most, point[axis])], [Infinity, -Infinity]))
  const [size, middle] = [ends.map(([least, most]) => Math.max(most - least, 1)), ends.map(([least, most]) => (least + most) / 2)]
  const metre = Math.min((width - 2 * edge) / size[0], (height - 2 * edge) / size[1])
  const x = (value) => width / 2 + (value - middle[0]) * metre
  const y = (value) => height / 2 - (value - middle[1]) * metre
  const power = 10 ** Math.floor(Math.log10(90 / metre))
  const step = power * [1, 2, 5, 10].find((times) => times * power * metre >= 90)
  const values = (axis, half) => {
    const first = Math.ceil((middle[axis] - half / metre) / step)
    return [...Array(Math.max(0, Math.floor((middle[axis] + half / metre) / step) - first + 1)).keys()].map((n) => (first + n) * step)
  }
  const labels = [
    make('text', { x: width - 6, y: height - 8, 'text-anchor': 'end' }, 'x in m'), make('text', { x: 6, y: 16 }, 'y in m')]
  for (const value of values(0, width / 2)) {
    const at = x(value)
    svg.append(make('line', { class: value ? 'grid' : 'axis', x1: at, x2: at, y1: 0, y2: height }))
    if (at > edge && at < width - 80) {
      labels.push(make('text', { x: at, y: height - 8, 'text-anchor': 'middle' }, short(value, 12)))
    }
  }
  for (const value of values(1, height / 2)) {
    const at = y(value)
    svg.append(make('line', { class: value ? 'grid' : 'axis', x1: 0, x2: width, y1: at, y2: at }))
    if (at > 36 && at < height - 26) labels.push(make('text', { x: 6, y: at - 4 }, short(value, 12)))
  }
  svg.append(...labels)
  tracks.forEach((track, n) => {
    const [[beginX, beginY], [endX, endY]] = [track[0], track.at(-1)]
    svg.append(
      make('polyline', { class: `track t${n % 6}`, points: track.map(([a, b]) => `${x(a).toFixed(1)},${y(b).toFixed(1)}`).join(' ') }),
      make('circle', { class: `start t${n % 6}`, cx: x(beginX), cy: y(beginY), r: 4 }),
      make('circle', { class: `now t${n % 6}`, cx: x(endX), cy: y(endY), r: 6 }))
  })
  return svg
}
