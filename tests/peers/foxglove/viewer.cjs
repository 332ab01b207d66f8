// A viewer: says in lines of JSON what it is told, and does what lines of JSON say. Arguments: the address.
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { WebSocket } = require("ws");
const readline = require("node:readline");

const tell = (event, more) => process.stdout.write(JSON.stringify({ event, ...more }) + "\n");
const hex = (view) => Buffer.from(view.buffer, view.byteOffset, view.byteLength).toString("hex");
const client = new FoxgloveClient({
  ws: new WebSocket(process.argv[2], [FoxgloveClient.SUPPORTED_SUBPROTOCOL], { perMessageDeflate: false }),
});
const topics = new Map();
const subscribed = new Map();

client.on("open", () => tell("open", {}));
client.on("close", () => process.exit(0));
client.on("error", (error) => tell("error", { text: String(error.message ?? error) }));
client.on("serverInfo", ({ name, capabilities }) => tell("info", { name, capabilities }));
client.on("status", ({ level, message, id }) => tell("status", { level, text: message, id }));
client.on("advertise", (channels) => {
  for (const { id, topic, encoding, schemaName, schema } of channels) {
    topics.set(topic, id);
    tell("channel", { topic, encoding, schemaName, schema });
  }
});
client.on("unadvertise", () => tell("unadvertise", {}));
client.on("message", ({ subscriptionId, data }) =>
  tell("message", { topic: subscribed.get(subscriptionId), body: hex(data) }),
);
client.on("advertiseServices", (services) => {
  for (const { id, name, type } of services) tell("service", { id, name, type });
});
client.on("serviceCallResponse", ({ callId, data }) => tell("answer", { call: callId, body: hex(data) }));
client.on("serviceCallFailure", ({ callId, message }) => tell("failure", { call: callId, text: message }));

readline.createInterface({ input: process.stdin }).on("line", (line) => {
  const order = JSON.parse(line);
  const body = Buffer.from(order.body ?? "", "hex");
  const view = new Uint8Array(body);
  if (order.do === "subscribe") {
    subscribed.set(client.subscribe(topics.get(order.topic)), order.topic);
  } else if (order.do === "advertise") {
    order.channel = client.advertise({ topic: order.topic, encoding: "json", schemaName: order.type });
    tell("advertised", { channel: order.channel });
  } else if (order.do === "publish") {
    client.sendMessage(order.channel, view);
  } else if (order.do === "call") {
    client.sendServiceCallRequest({
      serviceId: order.service, callId: order.call, encoding: order.encoding, data: new DataView(view.buffer),
    });
  } else if (order.do === "end") {
    client.close();
  }
}).on("close", () => client.close());
