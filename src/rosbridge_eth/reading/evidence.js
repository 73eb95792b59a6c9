// SPDX-License-Identifier: Apache-2.0
// Checks the evidence of a robot's records, as docs/evidence.md says it, with nothing but the language: SM3,
// SM2 signatures and X.509 (RFC 5280, as far as a robot's certificates go). It is written
// from that page and docs/log.md, not from the Python; tests hold both against each other and against the standards.
//
// evidence.verify(text, told) gives what the file shows, or throws a Wrong that says what does not hold.
'use strict'
const evidence = (() => {
  class Wrong extends Error {}
  const need = (holds, why) => {
    if (!holds) throw new Wrong(why)
  }

  // ---------------------------------------------------------------- bytes

  const utf8 = new TextEncoder()
  const DIGITS = [...Array(256).keys()].map((byte) => byte.toString(16).padStart(2, '0'))
  const hex = (bytes) => {
    let text = ''
    for (const byte of bytes) text += DIGITS[byte]
    return text
  }
  const unhex = (text) => Uint8Array.from({ length: text.length / 2 }, (_, n) => parseInt(text.substr(2 * n, 2), 16))
  const join = (...parts) => {
    const bytes = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0))
    let at = 0
    for (const part of parts) {
      bytes.set(part, at)
      at += part.length
    }
    return bytes
  }
  const big = (bytes) => BigInt('0x' + (hex(bytes) || '0'))
  const small = (bytes, what) => {
    const value = big(bytes)
    need(value < 2n ** 53n, `${what} is beyond all bounds`)
    return Number(value)
  }
  const word = (value, size = 32) => unhex(BigInt(value).toString(16).padStart(2 * size, '0'))
  const same = (a, b) => a.length === b.length && a.every((byte, n) => byte === b[n])

  // ---------------------------------------------------------------- SM3, GB/T 32905-2016

  const rotl = (x, n) => (x << n) | (x >>> (32 - n)) // JavaScript takes both counts modulo 32

  function sm3(...parts) {
    const message = join(...parts)
    const padded = new Uint8Array(Math.ceil((message.length + 9) / 64) * 64)
    padded.set(message)
    padded[message.length] = 0x80
    const view = new DataView(padded.buffer)
    view.setBigUint64(padded.length - 8, BigInt(message.length) * 8n)
    const v = Int32Array.of(
      0x7380166f, 0x4914b2b9, 0x172442d7, 0xda8a0600, 0xa96f30bc, 0x163138aa, 0xe38dee4d, 0xb0fb0e4e)
    const w = new Int32Array(68)
    const p1 = (x) => x ^ rotl(x, 15) ^ rotl(x, 23)
    for (let at = 0; at < padded.length; at += 64) {
      for (let j = 0; j < 16; j++) w[j] = view.getInt32(at + 4 * j)
      for (let j = 16; j < 68; j++) {
        w[j] = p1(w[j - 16] ^ w[j - 9] ^ rotl(w[j - 3], 15)) ^ rotl(w[j - 13], 7) ^ w[j - 6]
      }
      let [a, b, c, d, e, f, g, h] = v
      for (let j = 0; j < 64; j++) {
        const first = j < 16
        const ss1 = rotl((rotl(a, 12) + e + rotl(first ? 0x79cc4519 : 0x7a879d8a, j)) | 0, 7)
        const tt1 = ((first ? a ^ b ^ c : (a & b) | (a & c) | (b & c)) + d + (ss1 ^ rotl(a, 12)) + (w[j] ^ w[j + 4])) | 0
        const tt2 = ((first ? e ^ f ^ g : (e & f) | (~e & g)) + h + ss1 + w[j]) | 0
        ;[d, c, b, a] = [c, rotl(b, 9), a, tt1]
        ;[h, g, f, e] = [g, rotl(f, 19), e, tt2 ^ rotl(tt2, 9) ^ rotl(tt2, 17)]
      }
      ;[a, b, c, d, e, f, g, h].forEach((value, n) => (v[n] ^= value))
    }
    const digest = new DataView(new ArrayBuffer(32))
    v.forEach((value, n) => digest.setInt32(4 * n, value))
    return new Uint8Array(digest.buffer)
  }

  // ---------------------------------------------------------------- SM2 signatures, GB/T 32918.2-2016, 7.1

  const P = 0xfffffffeffffffffffffffffffffffffffffffff00000000ffffffffffffffffn
  const B = 0x28e9fa9e9d9f5e344d5a9e4bcf6509a7f39789f515ab8f92ddbcbd414d940e93n
  const N = 0xfffffffeffffffffffffffffffffffff7203df6b21c6052b53bbf40939d54123n
  const G = [
    0x32c4ae2c1f1981195f9904466a39c9948fe30bbff2660be1715a4589334c74c7n,
    0xbc3736a2f4f6779c59bdcee36b692153d0a9877cc62a474002df32e52139f0a0n, 1n]
  const A = P - 3n
  const mod = (x, m = P) => ((x % m) + m) % m

  // Jacobian coordinates; z = 0 is infinity. EFD shortw-jacobian-3, dbl-2001-b and add-1998-cmo.
  function double([x, y, z]) {
    const [delta, gamma] = [(z * z) % P, (y * y) % P]
    const beta = (x * gamma) % P
    const alpha = mod(3n * (x - delta) * (x + delta))
    const x3 = mod(alpha * alpha - 8n * beta)
    return [x3, mod(alpha * (4n * beta - x3) - 8n * gamma * gamma), mod((y + z) * (y + z) - gamma - delta)]
  }
  function add(a, b) {
    if (a[2] === 0n) return b
    if (b[2] === 0n) return a
    const [za, zb] = [(a[2] * a[2]) % P, (b[2] * b[2]) % P]
    const [ua, ub] = [(a[0] * zb) % P, (b[0] * za) % P]
    const sa = (((a[1] * zb) % P) * b[2]) % P
    const h = mod(ub - ua)
    const r = mod(((b[1] * za) % P) * a[2] - sa)
    if (h === 0n) return r === 0n ? double(a) : [1n, 1n, 0n]
    const hh = (h * h) % P
    const [hhh, v] = [(h * hh) % P, (ua * hh) % P]
    const x = mod(r * r - hhh - 2n * v)
    return [x, mod(r * (v - x) - sa * hhh), (((h * a[2]) % P) * b[2]) % P]
  }
  // key: 04 | x | y; the signature's r and s; identifier 1234567812345678 (GM/T 0009).
  function signed(key, message, r, s) {
    const [x, y] = [big(key.subarray(1, 33)), big(key.subarray(33))]
    const onCurve = key.length === 65 && key[0] === 4 && x < P && y < P && mod(y * y - x * x * x - A * x - B) === 0n
    if (!onCurve || r < 1n || r >= N || s < 1n || s >= N) return false
    const constants = [A, B, G[0], G[1]].map((value) => word(value))
    const z = sm3([0, 128], utf8.encode('1234567812345678'), ...constants, key.subarray(1))
    const e = big(sm3(z, message))
    const t = (r + s) % N
    if (t === 0n) return false
    const point = [x, y, 1n]
    const sums = [null, G, point, add(G, point)] // s * G + t * point, both at once
    let sum = [1n, 1n, 0n]
    for (let bit = 255n; bit >= 0n; bit--) {
      sum = double(sum)
      const which = Number((s >> bit) & 1n) + 2 * Number((t >> bit) & 1n)
      if (which) sum = add(sum, sums[which])
    }
    if (sum[2] === 0n) return false
    const expected = mod(r - e, N) // of the point's x, which is below P, modulo N
    return [expected, expected + N].some((value) => value < P && mod(value * sum[2] * sum[2] - sum[0]) === 0n)
  }

  // ---------------------------------------------------------------- DER and X.509, RFC 5280

  // One value: its tag, the whole of it, its content. DER's lengths have one form (X.690, 10.1).
  function element(der, at = 0) {
    let start = at + 2
    let size = der[at + 1]
    if (size >= 0x80) {
      start += size & 0x7f
      const length = der.subarray(at + 2, start)
      need(length.length >= 1 && length.length <= 3 && length[0] !== 0, 'a certificate is not DER')
      size = Number(big(length))
      need(size >= 0x80, 'a certificate is not DER')
    }
    need(start + size <= der.length, 'a certificate ends early')
    return { tag: der[at], whole: der.subarray(at, start + size), content: der.subarray(start, start + size) }
  }
  function elements(content) {
    const found = []
    for (let at = 0; at < content.length; at += found.at(-1).whole.length) found.push(element(content, at))
    return found
  }
  const one = (der) => {
    const found = element(der)
    need(found.whole.length === der.length, 'there is something behind a DER value')
    return found
  }
  const within = (part, tag) => {
    need(part?.tag === tag, 'a certificate is not in the form of one')
    return elements(part.content)
  }
  const SM2_WITH_SM3 = '06082a811ccf55018375'
  const SM2_KEY = '301306072a8648ce3d020106082a811ccf5501822d'
  const moment = ({ tag, content }) => {
    const text = String.fromCharCode(...content)
    const full = tag === 0x17 ? (text < '50' ? '20' : '19') + text : text
    const time = Date.parse(full.replace(/^(\d{4})(\d\d)(\d\d)(\d\d)(\d\d)(\d\d)Z$/, '$1-$2-$3T$4:$5:$6Z'))
    need(!Number.isNaN(time), 'a certificate has a time that is none')
    return time
  }
  const HARMLESS = new Set(['551d0e', '551d20', '551d23']) // identifiers of keys, and policies: any is taken
  const bits = (part) => {
    need(part?.tag === 0x03 && part.content.length > 0, 'a certificate is not in the form of one')
    return part.content.subarray(1)
  }

  function certificate(der) {
    const parts = within(one(der), 0x30)
    const [tbs, algorithm, signature] = parts
    need(parts.length === 3, 'a certificate is not in the form of one')
    const [version, , inner, issuer, validity, subject, key, ...rest] = within(tbs, 0x30)
    need(version?.tag === 0xa0 && hex(version.content) === '020102', 'a certificate is not of version 3')
    for (const used of [algorithm, inner]) {
      need(hex(within(used, 0x30)[0].whole) === SM2_WITH_SM3, 'a certificate is not signed with SM2 and SM3')
    }
    const [kind, point] = within(key, 0x30)
    need(hex(kind.whole) === SM2_KEY, 'a certificate is not for an SM2 key')
    const [from, until] = within(validity, 0x30).map(moment)
    const found = { tbs: tbs.whole, issuer: hex(issuer.whole), subject: hex(subject.whole), key: bits(point), from, until }
    need(hex(algorithm.whole) === hex(inner.whole) && signature?.content[0] === 0, 'a certificate is not in the form of one')
    const numbers = within(one(bits(signature)), 0x30)
    const isOne = ({ tag, content }) => tag === 2 && content[0] < 0x80 && (content[0] > 0 || !(content[1] < 0x80))
    need(numbers.length === 2 && numbers.every(isOne), 'a certificate is not DER')
    const [r, s] = numbers.map(({ content }) => big(content))
    Object.assign(found, { r, s, authority: false, usage: null, names: [] })
    const extensions = rest.find(({ tag }) => tag === 0xa3)
    const there = new Set()
    for (const extension of extensions ? within(one(extensions.content), 0x30) : []) {
      const parts = within(extension, 0x30)
      const id = hex(parts[0].content)
      need(!there.has(id) && there.add(id), 'a certificate has an extension twice')
      const value = parts.at(-1).content
      if (id === '551d13') found.authority = within(one(value), 0x30).some(({ tag, content }) => tag === 1 && content[0])
      else if (id === '551d0f') found.usage = bits(one(value))[0] // 80 digitalSignature, 40 nonRepudiation ... 08 keyAgreement, 04 keyCertSign
      else if (id === '551d11') {
        found.names = within(one(value), 0x30).map(({ tag, content }) => [tag & 0x1f, String.fromCharCode(...content)])
      } else if (!HARMLESS.has(id)) need(parts.length === 2 || !parts[1].content[0], `a certificate has a critical extension, ${id}`)
    }
    found.constrained = there.has('551d1e') // nameConstraints
    found.purposes = there.has('551d25') // extendedKeyUsage
    return found
  }

  // The robot's signing certificate of a registration, if the CA signed both for this robot; judged at the time given (ms),
  // or when the later one begins if that is later. What has to hold is the table of docs/log.md (Certificates).
  function signer(certificates, roots, robot, time = 0) {
    const first = element(certificates).whole
    const pair = [certificate(first), certificate(certificates.subarray(first.length))]
    const from = Math.max(...pair.map((made) => made.from))
    const at = Math.max(time, from)
    pair.forEach((made, n) => {
      const name = `6,urn:rosbridge-eth:robot:${robot}`
      need(made.names.length === 1 && String(made.names[0]) === name, `a certificate is not for ${robot}`)
      const issued = (root) =>
        root.subject === made.issuer && root.authority && !root.constrained && (root.usage === null || root.usage & 0x04) &&
        root.from <= at && at <= root.until && signed(root.key, made.tbs, made.r, made.s)
      need(roots.some(issued), 'the CA did not sign a certificate')
      need(at <= made.until, 'a certificate had ended')
      const [own, others] = n ? [0x08, 0xc0] : [0xc0, 0x38]
      need((made.usage & own) === own && !(made.usage & others) && !made.purposes, 'a certificate is for another use')
      need(!made.authority, "a certificate is a CA's")
    })
    return { key: pair[0].key, fingerprint: hex(sm3(first)), from, until: Math.min(pair[0].until, pair[1].until) }
  }

  // ---------------------------------------------------------------- the chunk, docs/log.md

  function chunkOf(data) {
    const form = (holds) => need(holds, 'a chunk is not in the form of one')
    const count = data[138]
    const end = 139 + count * 113
    form(data.length >= end + 64 && data[0] === 3 && data[1] <= 1)
    const field = (at, size) => data.subarray(at, at + size)
    const body = data.subarray(end + 64)
    const [records, length, digest] = [small(field(66, 4)), small(field(102, 4)), hex(field(106, 32))]
    const nothing = hex(sm3([]))
    form(body.length === 0 || body.length === length)
    form(records
      ? records <= 1000 && count >= 1 && count <= 16 && length % 64 === 16 && length > 16 && length < 2 ** 16
      : !count && !length && digest === nothing && hex(field(70, 32)) === nothing)
    form(big(field(58, 8)) < 253402300800000n)
    return {
      encoded: field(0, end), digest: hex(sm3(field(0, end))), goodbye: data[1] === 1, stream: hex(field(2, 16)),
      place: field(2, 24), number: big(field(18, 8)), previous: hex(field(26, 32)), sealed: small(field(58, 8)), records,
      root: field(70, 32), bodyDigest: digest, grants: [...Array(count).keys()].map((n) => field(139 + n * 113, 113)),
      r: big(field(end, 32)), s: big(field(end + 32, 32)), body, bare: length > 0 && !body.length,
    }
  }
  const isSigned = (chunk, log, key) => signed(
    key, join(utf8.encode(`rosbridge-eth/2 ${chunk.bare ? 'dropped' : 'chunk'}\0`), log, chunk.encoded), chunk.r, chunk.s)

  // RFC 9162, 2.1.3.2, with its names.
  function proven(root, records, index, salt, line, path) {
    let [fn, sn] = [index, records - 1]
    let r = sm3([0], salt, line)
    if (fn > sn) return false
    for (const p of path) {
      if (sn === 0) return false
      if (fn & 1 || fn === sn) {
        r = sm3([1], p, r)
        while (fn && !(fn & 1)) [fn, sn] = [fn >> 1, sn >> 1]
      } else r = sm3([1], r, p)
      ;[fn, sn] = [fn >> 1, sn >> 1]
    }
    return sn === 0 && same(r, root)
  }

  // What a line says, its long integers as text: JavaScript's numbers would lose digits of the times. As the robot writes
  // it: no white space, no needless escapes, no name twice; JSON.parse takes the last of two, and 1e400 for a number.
  const TEXT = String.raw`"[^"\\]*(?:\\.[^"\\]*)*"`
  const TOKEN = new RegExp(`${TEXT}|[-+.\\w]+|[^]`, 'g')
  const KINDS = Object.entries({
    message: '{"topic":T,"type":T,"source":T,"received_ns":N,"captured_ns":N,"clock":(?:true|false),"data":{.*}}',
    type: '{"type":T,"wire":T,"format":T,"definition":T}', lost: '{"lost":N,"topic":T,"why":T}',
    trigger: '{"trigger":T,"why":T,"at_ns":N}', stream: '{"stream":{"source":T,"software":T}}',
  }).map(([kind, form]) => {
    const names = form.replace(/"stream":\{.*\}\}/, '"stream":').match(/"\w+"(?=:)/g).join().replaceAll('"', '')
    const text = form.replace(/[{}]/g, '\\$&').replaceAll('T', TEXT).replaceAll('N', '(-?\\d+)')
    return [kind, names, new RegExp(`^${text}$`, 's')]
  })
  function lineOf(line) {
    const form = (holds) => need(holds, 'it is not in the one form of a record')
    form(utf8.encode(line).length <= 60 * 1024)
    const open = [] // of each level, an object's names, or null for an array
    const exact = line.match(TOKEN).map((token, n, tokens) => {
      if (token === '{' || token === '[') form(open.push(token === '{' ? new Set() : null) <= 100)
      else if (token === '}' || token === ']') open.pop()
      else if (token[0] === '"') {
        const text = JSON.parse(token)
        form(JSON.stringify(text) === token && !/\p{Cs}/u.test(text))
        if (tokens[n + 1] === ':') form(open.at(-1) && !open.at(-1).has(text) && open.at(-1).add(text))
      } else form(token.trim() && (!/[-\d]/.test(token[0]) || Number.isFinite(Number(token))))
      return token.length > 15 && /^-?[1-9]\d*$/.test(token) ? `"${token}"` : token
    })
    const content = JSON.parse(exact.join(''))
    const names = Object.keys(content).join()
    for (const [kind, members, text] of KINDS) {
      const [whole, ...counts] = (names === members && text.exec(line)) || []
      if (whole === undefined) continue
      form(counts.every((count) => BigInt(count) >= 0n && BigInt(count) < 2n ** 63n))
      return { kind, content }
    }
    return form(false)
  }

  // ---------------------------------------------------------------- the file

  const grouped = (fingerprint) => fingerprint.replace(/(.{4})(?=.)/g, '$1 ')
  const ascending = (list) => list.every((value, n) => n === 0 || list[n - 1] < value)
  const isCount = (value) => Number.isInteger(value) && value >= 0 && value < 2 ** 53
  const isHex = (size) => (value) => typeof value === 'string' && !/[^0-9a-f]/.test(value) &&
    (size === undefined ? value.length % 2 === 0 : value.length === 2 * size)
  const isList = (isOne, most, least = 0) => (value) =>
    Array.isArray(value) && least <= value.length && value.length <= most && value.every(isOne)
  const isObject = (members) => (value) => {
    need(value !== null && typeof value === 'object' && Object.keys(value).join() === Object.keys(members).join(),
      `it does not have the members ${Object.keys(members).join(', ')}`)
    for (const [name, fits] of Object.entries(members)) need(fits(value[name]), `its member ${name} is not in its form`)
    return true
  }
  const isEvidence = isObject({
    format: (value) => value === 'rosbridge-eth evidence 3',
    robot: (value) => typeof value === 'string' && /^[a-z0-9][a-z0-9_.-]{0,62}$/.test(value),
    tk: isHex(32), chain_id: isCount, genesis: isHex(32), contract: isHex(20),
    authorities: isList(isHex(), 16, 1), certificates: isList(isHex(), 1000, 1),
    chunks: isList(isObject({
      chunk: isCount, certificate: isCount, encoded: isHex(), first: isCount, hashes: isList(isHex(32), 1e5), block: isCount,
      transaction: isHex(32),
    }), 1e5, 1),
    records: isList(isObject({
      chunk: isCount, record: (value) => isCount(value) && value < 1000,
      line: (value) => typeof value === 'string' && !/\p{Cs}/u.test(value), salt: isHex(16), path: isList(isHex(32), 10),
    }), 1e5, 1),
  })

  function read(text) {
    let file
    need(text.length <= 2 ** 26, 'evidence has at most 64 MiB')
    try {
      file = JSON.parse(text)
    } catch {
      throw new Wrong('this is no evidence: it is not JSON')
    }
    isEvidence(file)
    const escaped = (char) => '\\u' + char.charCodeAt(0).toString(16).padStart(4, '0')
    need(JSON.stringify(file).replace(/[<\u007f-\uffff]/g, escaped) === text.trim(), 'the file is not in its one form')
    return file
  }

  function verify(text, told) {
    const file = read(text)
    const { robot } = file
    const log = join(sm3(word(file.chain_id), unhex(file.genesis), unhex(file.contract)), unhex(file.tk))
    const authorities = file.authorities.map(unhex)
    told('the file is whole and in its one form')

    const roots = authorities.map(certificate)
    const whole = ({ issuer, subject, key, tbs, r, s }) => issuer !== subject || signed(key, tbs, r, s)
    need(ascending(file.authorities) && roots.every(whole), "a CA's certificate is not whole, or there twice")
    const signers = file.certificates.map((one) => {
      try {
        return signer(unhex(one), roots, robot)
      } catch (error) { // whatever the operator registered: of what is no certificate a part may be undefined
        throw new Wrong(`a certificate of the robot does not hold: ${error.message}`)
      }
    })
    for (const one of signers) told(`the CA made the robot's certificate ${grouped(one.fingerprint)}`)

    need(ascending(file.chunks.map(({ chunk }) => chunk)), 'the chunks are not in order')
    const chunks = new Map(file.chunks.map((written) => {
      need(written.hashes[written.chunk - written.first], `chunk ${written.chunk} is of no batch`)
      const [chunk, by] = [chunkOf(unhex(written.encoded)), signers[written.certificate]]
      need(by && isSigned(chunk, log, by.key), `the robot did not sign chunk ${written.chunk}`)
      need(chunk.bare || hex(sm3(chunk.body)) === chunk.bodyDigest, `the body of chunk ${written.chunk} is another`)
      need(chunk.sealed <= by.until, `chunk ${written.chunk} was sealed after the end of the robot's certificate`)
      return [written.chunk, { ...chunk, written }]
    }))
    const used = new Set(file.chunks.map((one) => one.certificate))
    need(used.size === signers.length, 'there are certificates of which no chunk is')
    told('the robot signed the chunk of each record')

    need(ascending(file.records.map(({ chunk, record }) => chunk * 1000 + record)), 'the records are not in order')
    const records = file.records.map(({ chunk, record, line, salt, path }) => {
      try {
        const of = chunks.get(chunk)
        need(of, 'its chunk is not in the file')
        const holds = proven(of.root, of.records, record, unhex(salt), utf8.encode(line), path.map(unhex))
        need(holds, "it is not what the chunk's root commits to")
        const { kind, content } = lineOf(line)
        need(kind === 'message', 'it is no captured message')
        return { chunk, record, line, content, sealed: of.sealed, written: of.written }
      } catch (error) {
        throw new Wrong(`record ${record} of chunk ${chunk}: ${error.message}`)
      }
    })
    need(new Set(file.records.map((one) => one.chunk)).size === chunks.size, 'there are chunks of which no record is')
    told(`each record's path leads to the root of its chunk`)
    return {
      robot, chain: file.chain_id, genesis: '0x' + file.genesis, contract: '0x' + file.contract,
      signers: signers.map((one) => one.fingerprint), authorities: authorities.map((one) => hex(sm3(one))), records,
    }
  }

  return {
    verify, sm3, signed, grouped, Wrong, hex, unhex, join, word, big, certificate, element, signer, chunkOf, isSigned, lineOf,
  }
})()
if (typeof module === 'object') module.exports = evidence
