--[[
The inbox in Redis: every change is one call of this script, so it happens whole or not at all. What only reads is
plain commands, in redis.py.

Keys. All begin with KEYS[1] ("rosbridge-eth:2:<ledger>:"), so operators can share a Redis. ROBOT is Tk in hex; a
number is 8 bytes, big-endian.

  meta           hash    id (random, made with the inbox), ledger, bytes (of all rows)
  robots         hash    ROBOT -> bytes of its rows, of all of which there ever was a row or a state
  state:ROBOT    string  JSON
  log:ROBOT      Stream  the robot's rows, in order, with Redis' own ids; one field r, packed, big-endian:
                           digest of the header 32, keccak256 of the chunk 32, stream 16, number 8, size 4, records 4,
                           taken at 8 (double); then C, R, B, 8 each: chunks, records and bytes ever taken, with this
                           row, so that what lies between two rows need not be counted
  ever:ROBOT     hash    C, R, B
  chunks:ROBOT   hash    digest -> the encoded chunk
  places:ROBOT   hash    keccak256 -> entry of `log`; stream and number -> digest
  heads:ROBOT    hash    stream -> number and digest of its newest chunk ever taken
  dead           Stream  dead letters: t Tk, w why, a taken at, c the encoded chunk

At `maxmemory` Redis refuses a script's first write if it takes memory, and looks at no other. `append` begins with
one that does, and is refused whole; the others begin with one that frees, and go through: a full Redis drains.
]]
local operation, id, run_id, robot = unpack(ARGV, 1, 4)
local P = KEYS[1]
local META, ROBOTS, LOG, EVER = P .. 'meta', P .. 'robots', P .. 'log:' .. robot, P .. 'ever:' .. robot
local CHUNKS, PLACES, HEADS = P .. 'chunks:' .. robot, P .. 'places:' .. robot, P .. 'heads:' .. robot
local ROW = '>c32c32c24I4I4dI8I8I8'
local call = redis.call

-- Whether the 8-byte number a is above b. Lua's own comparison asks the locale.
local function above(a, b)
  local a1, a2 = struct.unpack('>I4I4', a)
  local b1, b2 = struct.unpack('>I4I4', b)
  return a1 > b1 or (a1 == b1 and a2 > b2)
end

-- Add a row; its chunk is there already if `encoded` is nil.
local function add(row, encoded)
  local chunks = call('HINCRBY', EVER, 'C', 1)
  local records, bytes = call('HINCRBY', EVER, 'R', row.r), call('HINCRBY', EVER, 'B', row.z)
  local entry = call('XADD', LOG, '*', 'r',
    struct.pack(ROW, row.d, row.h, row.p, row.z, row.r, row.a, chunks, records, bytes))
  call('HSET', PLACES, row.h, entry, row.p, row.d)
  if encoded then
    call('HSET', CHUNKS, row.d, encoded)
    call('HINCRBY', ROBOTS, robot, row.z)
    call('HINCRBY', META, 'bytes', row.z)
  end
end

-- The row in an entry of `log`, {id, {'r', row}}
local function read(entry)
  local digest, hash, place, size, records, taken_at = struct.unpack(ROW, entry[2][2])
  return {d = digest, h = hash, p = place, z = size, r = records, a = taken_at}
end

-- Remove an entry of `log` and its chunk, which becomes a dead letter if there is a reason.
local function remove(entry, tk, why)
  local row = read(entry)
  if why then
    call('XADD', P .. 'dead', '*', 't', tk, 'w', why, 'a', row.a, 'c', call('HGET', CHUNKS, row.d))
  end
  call('XDEL', LOG, entry[1])
  call('HDEL', CHUNKS, row.d)
  call('HDEL', PLACES, row.h, row.p)
  call('HINCRBY', ROBOTS, robot, -row.z)
  call('HINCRBY', META, 'bytes', -row.z)
end

local function raise(stream, number, digest)
  local known = call('HGET', HEADS, stream)
  if not known or above(number, known) then call('HSET', HEADS, stream, number .. digest) end
end

-- A row of seven arguments, its chunk, and its stream and number
local function row_of(i, now)
  local stream, number, digest, hash, size, records, encoded = unpack(ARGV, i, i + 6)
  return {d = digest, h = hash, p = stream .. number, z = size, r = records, a = now}, encoded, stream, number
end

-- S(tored), K(nown), D(ifferent), or F(ull)
local function append(share, max_bytes, row, encoded, stream, number)
  local head = call('HGET', HEADS, stream)
  if head and not above(number, head) then
    local there = head:sub(1, 8) == number and head:sub(9) or call('HGET', PLACES, row.p)
    return (not there or there == row.d) and 'K' or 'D'
  end
  if (call('HGET', ROBOTS, robot) or 0) + row.z > tonumber(share)
    or call('HGET', META, 'bytes') + row.z > tonumber(max_bytes) then return 'F' end
  add(row, encoded)
  raise(stream, number, row.d)
  return 'S'
end

if operation == 'open' then -- the id and the ledger found, after making the inbox if there is none
  if call('EXISTS', META) == 0 then call('HSET', META, 'id', id, 'ledger', ARGV[5], 'bytes', 0) end
  return call('HMGET', META, 'id', 'ledger')
end
if call('HGET', META, 'id') ~= id or not call('INFO', 'server'):find('run_id:' .. run_id, 1, true) then
  return redis.error_reply('EXCHANGED this is not the inbox that it was')
end
if operation == 'append' then -- now share max_bytes {stream number digest hash size records encoded}
  local outcomes, full = {}, false
  for i = 8, #ARGV, 7 do
    outcomes[#outcomes + 1] = append(full and 0 or ARGV[6], ARGV[7], row_of(i, ARGV[5]))
    full = full or outcomes[#outcomes] == 'F'
  end
  return table.concat(outcomes)
end
call('HDEL', META, '') -- frees, if nothing
if operation == 'save' then -- state
  call('HINCRBY', ROBOTS, robot, 0)
  call('SET', P .. 'state:' .. robot, ARGV[5])
elseif operation == 'raise_heads' then -- {stream number digest}
  for i = 5, #ARGV, 3 do raise(ARGV[i], ARGV[i + 1], ARGV[i + 2]) end
elseif operation == 'remove' then -- tk why|"" dead_letters {entry}
  local why = ARGV[6] ~= '' and ARGV[6]
  for i = 8, #ARGV do
    local entry = call('XRANGE', LOG, ARGV[i], ARGV[i])[1]
    if entry then remove(entry, ARGV[5], why) end
  end
  call('XTRIM', P .. 'dead', 'MAXLEN', ARGV[7])
elseif operation == 'put_in_front' then -- now count {as of append} {digest on the chain}
  local gone, rest, on_chain = {}, {}, 7 + 7 * ARGV[6]
  for i = on_chain, #ARGV do gone[ARGV[i]] = true end
  for _, entry in ipairs(call('XRANGE', LOG, '-', '+')) do
    local row = read(entry)
    if gone[row.d] then remove(entry) else rest[#rest + 1] = row end
  end
  call('DEL', LOG)
  for i = 7, on_chain - 1, 7 do add(row_of(i, ARGV[5])) end
  for _, row in ipairs(rest) do add(row) end
end
