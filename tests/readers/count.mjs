// Counts what is in an MCAP file with Foxglove's reader, which knows nothing of ours: once from the front to the end as
// a stream, once by the index at its end. Both check every checksum.
//
//   node count.mjs LOG…      prints {LOG: {"stream": counts, "index": counts}}, where counts are by topic
//
// A file that either way cannot be read in full ends it with the reader's own words and exit code 1.

import { open } from "node:fs/promises";
import { createReadStream } from "node:fs";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import zstd from "@foxglove/wasm-zstd";

await zstd.isLoaded;
const decompressHandlers = { zstd: (data, size) => zstd.decompress(data, Number(size)) };

/** Count a message of a topic, its bytes, and the first and last log time [ns]. */
function add(counts, topic, message) {
  const known = (counts[topic] ??= { count: 0, bytes: 0, first: message.logTime, last: message.logTime });
  known.count += 1;
  known.bytes += message.data.byteLength;
  if (message.logTime < known.first) known.first = message.logTime;
  if (message.logTime > known.last) known.last = message.logTime;
}

async function asStream(path) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  const [topics, counts] = [new Map(), {}];
  for await (const block of createReadStream(path)) {
    reader.append(block);
    for (let record; (record = reader.nextRecord()); ) {
      if (record.type === "Channel") topics.set(record.id, record.topic);
      else if (record.type === "Message") add(counts, topics.get(record.channelId), record);
    }
  }
  if (!reader.done()) throw new Error("the file has no end");
  return counts;
}

async function byIndex(path) {
  const file = await open(path);
  try {
    const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file), decompressHandlers });
    const counts = {};
    let messages = 0n;
    for await (const message of reader.readMessages({ validateCrcs: true })) {
      add(counts, reader.channelsById.get(message.channelId).topic, message);
      messages += 1n;
    }
    for await (const _ of reader.readMetadata()); // each must be where the index says
    for await (const _ of reader.readAttachments({ validateCrcs: true }));
    const counted = reader.statistics?.messageCount;
    if (counted !== messages) throw new Error(`the file's statistics count ${counted} messages, its index of ${messages}`);
    return counts;
  } finally {
    await file.close();
  }
}

const found = {};
for (const path of process.argv.slice(2)) {
  try {
    found[path] = { stream: await asStream(path), index: await byIndex(path) };
  } catch (error) {
    console.error(`${path}: ${error.message}`);
    process.exit(1);
  }
}
// Times in ns are beyond what a JSON number holds exactly, so they are written as text.
console.log(JSON.stringify(found, (_, value) => (typeof value === "bigint" ? value.toString() : value), 2));
