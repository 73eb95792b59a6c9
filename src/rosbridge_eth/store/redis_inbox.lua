--[[
The inbox in Redis: every change is one call of this script, so it happens whole or not at all.

Keys. All begin with KEYS[1] ("rosbridge-eth:<contract>:"), so operators can share a Redis. ROBOT is Tk in hex.

  meta           hash    format, binding (chain and contract), records and bytes (held, dead letters included),
                         streams and turns (counters)
  records        Stream  the records to be written, in the order of arrival:
                           t ROBOT, s stream, q seq (8 bytes, big-endian), a arrived, c ciphertext,
                           d blake2b-128 of the ciphertext
                         Its consumer group "ledger" lists what is given out (XPENDING): to whom, how often.
  streams        hash    ROBOT and stream -> the stream's number (8 bytes), counted as they first arrive
  queue:ROBOT    zset    the robot's records in the order they are given out; all scores are 0
                         member = PLACE = stream's number 8, seq 8, id of the entry in `records`
  lease:ROBOT    zset    PLACE -> end of its lease, seconds
  holder         hash    ROBOT -> who leases it, or did last
  line           zset    robots that have records -> when it was last their turn
  finished:NNSS  hash    identities that are finished with, 128 to a hash so that Redis packs them closely
                         (stream's number 8, seq without its last 7 bits 8): last byte of seq -> "1" done or "2" dead,
                         and d, to know the ciphertext again
  done           Stream  n (stream's number, seq), a (when): the done identities in the order they are forgotten
  dead           Stream  dead letters: t s q c as above, x (1: conflict), r reason, a when; entry 0-n is the n-th
  conflicts      set     stream's number, seq, digest of every conflict in `dead`

Why the group is not simply read: XREADGROUP gives out in the order of arrival, which datagrams and several workers
shuffle, and it would split a robot among consumers. So `queue` says what comes next, and XCLAIM FORCE gives it to the
consumer, also if it was given out before to one that died. Ends of leases are kept here because the group's own clock
is the server's idle time, which no test can set.

Numbers that are not small integers pass as text: Lua prints 14 digits of a float.

At `maxmemory` Redis refuses a script's first write if it takes memory, and looks at no other. So `append` begins with
one that does, and is refused whole; `lease` and `finish` begin with one that frees, and go through: a full Redis drains.
]]
local P = KEYS[1]
local META, RECORDS, STREAMS, LINE = P .. 'meta', P .. 'records', P .. 'streams', P .. 'line'
local HOLDER, DONE, DEAD, CONFLICTS = P .. 'holder', P .. 'done', P .. 'dead', P .. 'conflicts'
local QUEUE, LEASE, FINISHED = P .. 'queue:', P .. 'lease:', P .. 'finished:'
local GROUP, NOBODY = 'ledger', '(released)'
local call = redis.call

-- The PLACE of a record to be written, or nil. name: stream's number and seq.
local function find(robot, name)
  return call('ZRANGEBYLEX', QUEUE .. robot, '[' .. name, '[' .. name .. '\255', 'LIMIT', 0, 1)[1]
end

-- The entry of `records` that a PLACE names.
local function id_in(place)
  return place:sub(17)
end

-- The fields of an entry of `records`, as a table.
local function read(id)
  local entry = call('XRANGE', RECORDS, id, id)[1]
  if not entry then error('DAMAGED the stream lacks an entry that the queue names') end
  local fields, flat = {}, entry[2]
  for i = 1, #flat, 2 do fields[flat[i]] = flat[i + 1] end
  return fields
end

-- Where a finished identity is noted: key and field.
local function note(name)
  local last = name:byte(16)
  return FINISHED .. name:sub(1, 15) .. string.char(last - last % 128), string.char(last)
end

local operations = {}

-- open binding: the binding found, after making the inbox if there is none.
function operations.open(binding)
  if call('EXISTS', META) == 0 then
    call('HSET', META, 'format', 1, 'binding', binding, 'records', 0, 'bytes', 0, 'streams', 0, 'turns', 0)
    call('XGROUP', 'CREATE', RECORDS, GROUP, '0', 'MKSTREAM')
  end
  return call('HMGET', META, 'format', 'binding')
end

-- append now max_records max_bytes {ROBOT stream seq digest ciphertext}: a letter for each; see redis_inbox.py
function operations.append(now, max_records, max_bytes)
  local held = call('HMGET', META, 'records', 'bytes')
  local records, bytes = tonumber(held[1]), tonumber(held[2])
  max_records, max_bytes = tonumber(max_records), tonumber(max_bytes)
  local outcomes = {}
  for i = 5, #ARGV, 5 do
    local robot, stream, seq, digest, ciphertext = unpack(ARGV, i, i + 4)
    local number = call('HGET', STREAMS, robot .. stream)
    local place, finished = nil, nil
    if number then
      place = find(robot, number .. seq)
      if not place then finished = call('HGET', note(number .. seq)) end
    end
    local same = (place and read(id_in(place)).c == ciphertext) or (finished and finished:sub(2) == digest)
    if same then
      outcomes[#outcomes + 1] = 'D'
    elseif records + 1 > max_records or bytes + #ciphertext > max_bytes then
      outcomes[#outcomes + 1] = 'F'
    elseif place or finished then
      if call('SADD', CONFLICTS, number .. seq .. digest) == 1 then
        call('XADD', DEAD, '0-' .. (call('XLEN', DEAD) + 1), 't', robot, 's', stream, 'q', seq, 'x', 1,
          'r', 'this identity is taken by other bytes', 'a', now, 'c', ciphertext)
        records, bytes = records + 1, bytes + #ciphertext
      end
      outcomes[#outcomes + 1] = 'C'
    else
      if not number then
        number = struct.pack('>I8', call('HINCRBY', META, 'streams', 1))
        call('HSET', STREAMS, robot .. stream, number)
      end
      local id = call('XADD', RECORDS, '*', 't', robot, 's', stream, 'q', seq, 'a', now, 'd', digest, 'c', ciphertext)
      if call('ZADD', QUEUE .. robot, 0, number .. seq .. id) == 1 and not call('ZSCORE', LINE, robot) then
        call('ZADD', LINE, call('HINCRBY', META, 'turns', 1), robot)
      end
      records, bytes = records + 1, bytes + #ciphertext
      outcomes[#outcomes + 1] = 'N'
    end
  end
  if records ~= tonumber(held[1]) then
    call('HSET', META, 'records', string.format('%d', records), 'bytes', string.format('%d', bytes))
  end
  return table.concat(outcomes)
end

-- May `consumer` lease something of this robot?
local function open_to(robot, consumer, now)
  local out = call('ZCOUNT', LEASE .. robot, '(' .. now, '+inf')
  return out < call('ZCARD', QUEUE .. robot) and (out == 0 or call('HGET', HOLDER, robot) == consumer)
end

-- lease consumer now until limit max_bytes ROBOT|"": {ROBOT {stream seq arrived attempts ciphertext} ...} or {}
function operations.lease(consumer, now, till, limit, max_bytes, asked)
  local robot
  for _, candidate in ipairs(asked ~= '' and {asked} or call('ZRANGE', LINE, 0, -1)) do
    if open_to(candidate, consumer, now) then
      robot = candidate
      break
    end
  end
  if not robot then return {} end
  call('ZREMRANGEBYSCORE', LEASE .. robot, '-inf', now)
  local out = {}
  for _, place in ipairs(call('ZRANGE', LEASE .. robot, 0, -1)) do out[place] = true end
  limit, max_bytes = tonumber(limit), tonumber(max_bytes)
  local given, places, total, from, full = {}, {}, 0, 0, false
  while not full do
    local page = call('ZRANGE', QUEUE .. robot, from, from + 127)
    if #page == 0 then break end
    from = from + #page
    for _, place in ipairs(page) do
      if not out[place] then
        local fields = #places < limit and read(id_in(place))
        if not fields or (#places > 0 and total + #fields.c > max_bytes) then
          full = true
          break
        end
        total = total + #fields.c
        if #places == 0 then given[1] = fields.t end
        local before = call('XPENDING', RECORDS, GROUP, id_in(place), id_in(place), 1)[1]
        given[#given + 1] = {fields.s, fields.q, fields.a, (before and before[4] or 0) + 1, fields.c}
        places[#places + 1] = place
      end
    end
  end
  call('ZADD', LINE, call('HINCRBY', META, 'turns', 1), robot)
  call('HSET', HOLDER, robot, consumer)
  for n, place in ipairs(places) do
    call('ZADD', LEASE .. robot, till, place)
    call('XCLAIM', RECORDS, GROUP, consumer, 0, id_in(place), 'RETRYCOUNT', given[n + 1][4], 'FORCE', 'JUSTID')
  end
  return given
end

-- release consumer {ROBOT stream seq}. It keeps count: the entry stays pending, but nobody's.
function operations.release(consumer)
  for i = 3, #ARGV, 3 do
    local robot, stream, seq = unpack(ARGV, i, i + 2)
    local number = call('HGET', STREAMS, robot .. stream)
    local place = number and call('HGET', HOLDER, robot) == consumer and find(robot, number .. seq)
    if place and call('ZREM', LEASE .. robot, place) == 1 then
      call('XCLAIM', RECORDS, GROUP, NOBODY, 0, id_in(place), 'JUSTID')
    end
  end
end

-- reclaim consumer: all that it leased is released
function operations.reclaim(consumer)
  for _, robot in ipairs(call('ZRANGE', LINE, 0, -1)) do
    if call('HGET', HOLDER, robot) == consumer then
      local places = call('ZRANGE', LEASE .. robot, 0, -1)
      call('DEL', LEASE .. robot)
      for _, place in ipairs(places) do call('XCLAIM', RECORDS, GROUP, NOBODY, 0, id_in(place), 'JUSTID') end
    end
  end
end

-- held ROBOT limit: {stream seq ciphertext} for each of its first records, leased or not
function operations.held(robot, limit)
  local found = {}
  for _, place in ipairs(call('ZRANGE', QUEUE .. robot, 0, tonumber(limit) - 1)) do
    local fields = read(id_in(place))
    found[#found + 1] = {fields.s, fields.q, fields.c}
  end
  return found
end

-- finish "1"|"2" reason now {ROBOT stream seq}: done, or dead for that reason
function operations.finish(state, reason, now)
  local records, bytes = 0, 0
  for i = 5, #ARGV, 3 do
    local robot, stream, seq = unpack(ARGV, i, i + 2)
    local number = call('HGET', STREAMS, robot .. stream)
    local place = number and find(robot, number .. seq)
    if place then
      local fields = read(id_in(place))
      call('XACK', RECORDS, GROUP, id_in(place))
      call('XDEL', RECORDS, id_in(place))
      call('ZREM', QUEUE .. robot, place)
      call('ZREM', LEASE .. robot, place)
      if call('EXISTS', QUEUE .. robot) == 0 then
        call('ZREM', LINE, robot)
        call('HDEL', HOLDER, robot)
      end
      local key, field = note(number .. seq)
      call('HSET', key, field, state .. fields.d)
      if state == '1' then
        call('XADD', DONE, '*', 'n', number .. seq, 'a', now)
        records, bytes = records + 1, bytes + #fields.c
      else
        call('XADD', DEAD, '0-' .. (call('XLEN', DEAD) + 1), 't', robot, 's', stream, 'q', seq, 'x', 0,
          'r', reason, 'a', now, 'c', fields.c)
      end
    end
  end
  if records > 0 then
    call('HINCRBY', META, 'records', -records)
    call('HINCRBY', META, 'bytes', -bytes)
  end
end

-- state now ROBOT stream seq: "U"nknown "W"aiting "L"eased, or "1" "2"
function operations.state(now, robot, stream, seq)
  local number = call('HGET', STREAMS, robot .. stream)
  if not number then return 'U' end
  local place = find(robot, number .. seq)
  if place then
    local till = call('ZSCORE', LEASE .. robot, place)
    return till and tonumber(till) > tonumber(now) and 'L' or 'W'
  end
  local finished = call('HGET', note(number .. seq))
  return finished and finished:sub(1, 1) or 'U'
end

-- statistics now: depth, leased, done, dead, bytes, oldest arrival or ""
function operations.statistics(now)
  local leased = 0
  for _, robot in ipairs(call('ZRANGE', LINE, 0, -1)) do
    leased = leased + call('ZCOUNT', LEASE .. robot, '(' .. now, '+inf')
  end
  local oldest, arrived = call('XRANGE', RECORDS, '-', '+', 'COUNT', 1)[1], ''
  if oldest then arrived = read(oldest[1]).a end
  return {call('XLEN', RECORDS), leased, call('XLEN', DONE), call('XLEN', DEAD), tonumber(call('HGET', META, 'bytes')),
    arrived}
end

-- forget done_before limit: how many. Consumers that hold nothing go too: every process of a server is a new one.
function operations.forget(before, limit)
  local forgotten = 0
  for _, entry in ipairs(call('XRANGE', DONE, '-', '+', 'COUNT', limit)) do
    local name, at = entry[2][2], entry[2][4]
    if tonumber(at) >= tonumber(before) then break end
    call('HDEL', note(name))
    call('XDEL', DONE, entry[1])
    forgotten = forgotten + 1
  end
  for _, consumer in ipairs(call('XINFO', 'CONSUMERS', RECORDS, GROUP)) do
    if consumer[4] == 0 then call('XGROUP', 'DELCONSUMER', RECORDS, GROUP, consumer[2]) end
  end
  return forgotten
end

if ARGV[1] ~= 'open' and call('EXISTS', META) == 0 then
  return redis.error_reply('LOST there is no inbox here any more')
end
return operations[ARGV[1]](unpack(ARGV, 2, 8))
