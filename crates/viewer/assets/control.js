// Orders to the graph and its log, for a browser that has the token which the command has printed in the address.

const remembered = (() => { try { return sessionStorage; } catch { return null; } })();
let token = remembered?.getItem("token") ?? null, graph = null;
const takeToken = () => {
  if (location.hash.length < 2 || graspInAddress() !== null) return;
  token = location.hash.slice(1);
  remembered?.setItem("token", token);
  // It is not seen over a shoulder, nor kept in the history.
  history.replaceState(null, "", location.pathname);
};
takeToken();
window.addEventListener("hashchange", takeToken);
const eventsAddress = () => (token ? `/events?token=${encodeURIComponent(token)}` : "/events");
const headers = () => ({ Authorization: `Bearer ${token}`, "Content-Type": "application/json" });

const showLog = (lines) => {
  const body = byId("log"), region = body.closest("div");
  const isAtEnd = region.scrollTop + region.clientHeight >= region.scrollHeight - 4;
  lines.forEach(({ time, operator, level, text, fields }, idx) => {
    const values = Object.entries(fields ?? {}).map(([name, value]) => ` ${name}=${JSON.stringify(value)}`).join("");
    fill(body, idx, [time, operator, level ?? "", text + values], [], ["error", "warn"].includes(level) ? [2] : []);
  });
  cut(body, lines.length);
  if (isAtEnd) region.scrollTop = region.scrollHeight;
};
// A server that knows the token gives the log, and takes orders.
const readLog = async () => {
  let answer = null;
  try {
    if (token && !document.hidden) answer = await fetch("/log", { headers: headers() });
  } catch { /* The stream of events says that the connection is broken. */ }
  if (answer !== null) for (const id of ["control", "log-part"]) byId(id).hidden = !answer.ok;
  if (answer?.ok) showLog(await answer.json());
  setTimeout(readLog, 1000);
};

const order = async (order) => {
  // To stop is possible at any time.
  const buttons = byId("control").querySelectorAll("form button");
  buttons.forEach((button) => { button.disabled = true; });
  byId("answer").textContent = order.compare_secs > 0 ? `compares for ${order.compare_secs} s` : "…";
  byId("answer").classList.remove("trouble");
  try {
    const answer = await fetch("/orders", { method: "POST", headers: headers(), body: JSON.stringify(order) });
    byId("answer").textContent = await answer.text();
    byId("answer").classList.toggle("trouble", !answer.ok);
  } catch (error) {
    byId("answer").textContent = `no answer: ${error.message}`;
    byId("answer").classList.add("trouble");
  }
  buttons.forEach((button) => { button.disabled = false; });
};
// Choices are made again only if they are others, so that a choice stays.
const choose = (id, texts) => {
  const known = [...byId(id).options].map((option) => option.text);
  if (known.join("\n") !== texts.join("\n")) byId(id).replaceChildren(...texts.map((text) => new Option(text)));
};
const presentValue = () => {
  const [node, ...param] = byId("set-param").value.split(".");
  byId("set-value").value = graph?.params[node]?.[param.join(".")] ?? "";
};
const showChoices = (present) => {
  if (!token) return;
  graph = present;
  const before = byId("set-param").value;
  choose("set-param", Object.entries(graph.params).flatMap(([node, of]) => Object.keys(of).map((name) => `${node}.${name}`)));
  choose("swap-node", graph.nodes.map(({ node }) => node));
  if (byId("set-param").value !== before) presentValue();
};
byId("set-param").addEventListener("change", presentValue);
byId("set").addEventListener("submit", (event) => {
  event.preventDefault();
  const [node, ...param] = byId("set-param").value.split(".");
  order({ order: "set", node, param: param.join("."), value: byId("set-value").value });
});
byId("swap").addEventListener("submit", (event) => {
  event.preventDefault();
  const changes = byId("swap-changes").value.split(/\s+/).filter((change) => change !== "");
  order({
    order: "swap", node: byId("swap-node").value, changes, compare_secs: Number(byId("swap-compare").value),
    min_agreement: Number(byId("swap-agreement").value),
  });
});
// The first click asks, the second stops.
const unsure = () => {
  byId("stop").textContent = "Stop the graph";
  byId("stop").classList.remove("sure");
};
byId("stop").addEventListener("blur", unsure);
byId("stop").addEventListener("click", () => {
  if (!byId("stop").classList.contains("sure")) {
    byId("stop").textContent = "Click again to stop the graph";
    byId("stop").classList.add("sure");
    return;
  }
  unsure();
  order({ order: "stop" });
});
