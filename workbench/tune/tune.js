// Glue between the page and Rerun's viewer: starts it, feeds it, and passes clicks on.
"use strict";

window.bench = (() => {
  let handle = null;
  let socket = null;
  let pieces = 0;
  let begun = false;
  const opened = location.search;
  const channel = "bench";

  const say = (text, hidden) => {
    const cover = document.getElementById("viewer-cover");
    if (!cover) return;
    cover.textContent = text;
    cover.style.display = hidden ? "none" : "flex";
  };

  const feed = () => {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${scheme}://${location.host}${window.benchStream || "/stream"}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => {
      handle.send_rrd_to_channel(channel, new Uint8Array(event.data));
      pieces += 1;
      // Told only after the viewer has had the chance to draw: the server keeps to this pace.
      const told = socket;
      let once = false;
      const taken = () => {
        if (once) return;
        once = true;
        if (told.readyState === WebSocket.OPEN) told.send("1");
      };
      // A page that nobody sees draws nothing, and must not hold up the others.
      if (document.hidden) taken();
      requestAnimationFrame(() => setTimeout(taken, 0));
      setTimeout(taken, 200);
      if (pieces === 1) setTimeout(() => say("", true), 150);
    };
    socket.onclose = () => {
      say("connection lost; trying again …", false);
      pieces = 0;
      setTimeout(feed, 700);
    };
  };

  // What the address asks for is taken once: a page that comes again by itself, after a lost
  // connection, must not bring back an older state over what other pages have changed since.
  const restore = (run) => {
    const again = performance.getEntriesByType("navigation")[0]?.type === "reload"
      && sessionStorage.getItem("bench") === run;
    sessionStorage.setItem("bench", run);
    if (!again && opened.length > 1) emitEvent("bench_restore", opened.slice(1));
  };

  const start = async (version, run) => {
    if (begun) return;
    begun = true;
    restore(run);
    const canvas = document.getElementById("viewer");
    // The viewer's graphics layer logs tens of thousands of lines, which take longer than it does.
    console.debug = () => {};
    try {
      await wasm_bindgen({ module_or_path: `/viewer/${version}/re_viewer_bg.wasm` });
      handle = new wasm_bindgen.WebHandle({
        url: [],
        hide_welcome_screen: true,
        persist: false,
        theme: "dark",
        memory_limit: "1GB",
        check_for_updates_on_startup: false,
        panel_state_overrides: {
          top: "Hidden", blueprint: "Hidden", selection: "Hidden", time: "Hidden",
        },
        on_viewer_event: (text) => {
          const event = typeof text === "string" ? JSON.parse(text) : text;
          if (event.type !== "selection_change" || !event.items.length) return;
          emitEvent("viewer_selection", event.items);
          // What is selected already tells of no further click: the selection is given up again.
          const escape = { key: "Escape", code: "Escape", bubbles: false };
          setTimeout(() => canvas.dispatchEvent(new KeyboardEvent("keydown", escape)), 60);
        },
      });
      await handle.start(canvas);
      handle.toggle_panel_overrides(true);
      handle.open_channel(channel, "workbench tune");
      feed();
    } catch (error) {
      say(`Rerun's viewer did not start: ${error}`, false);
    }
  };

  let panels = false;
  const togglePanels = () => {
    panels = !panels;
    if (handle) handle.toggle_panel_overrides(!panels);
  };

  // The page's address holds its state, so that it can be kept and opened again.
  const address = (query) => history.replaceState(null, "", query ? `?${query}` : location.pathname);

  // Thresholds on a histogram: vertical lines that can be dragged.
  const threshold = (id, cuts) => {
    const element = getElement(id);
    const chart = element && element.chart;
    if (!chart) return setTimeout(() => threshold(id, cuts), 200);
    const state = (chart.benchState = chart.benchState || { held: null, told: 0, wired: false });
    if (state.held === null) state.cuts = cuts;
    const draw = () => chart.setOption({
      series: [{
        id: "counts",
        markLine: {
          silent: true, symbol: "none", animation: false,
          data: state.cuts.map((cut, k) => ({
            xAxis: cut.value,
            lineStyle: {
              color: cut.moves ? "#ff8a3d" : "#8b93a1", width: cut.moves ? 2 : 1,
              type: cut.moves ? "solid" : "dashed",
            },
            label: {
              formatter: `${cut.name} ${cut.value.toPrecision(3)}`, color: "#e6e8ec", fontSize: 10,
              position: "end", distance: [0, 2 + 11 * (k % 2)],
            },
          })),
        },
      }],
    });
    draw();
    if (state.wired) return;
    state.wired = true;
    const canvas = chart.getZr();
    const nearest = (x) => {
      let best = null;
      state.cuts.forEach((cut, k) => {
        const away = Math.abs(chart.convertToPixel({ xAxisIndex: 0 }, cut.value) - x);
        if (cut.moves && away < 9 && (best === null || away < best.away)) best = { k, away };
      });
      return best === null ? null : best.k;
    };
    const tell = (settled) => element.$emit
      ? element.$emit("threshold", { line: state.held, value: state.cuts[state.held].value, settled })
      : null;
    // The axis may follow the data while a line is held: what counts is how far the hand has moved.
    canvas.on("mousedown", (event) => {
      state.held = nearest(event.offsetX);
      if (state.held === null) return;
      const value = (x) => chart.convertFromPixel({ xAxisIndex: 0 }, x);
      state.from = { x: event.offsetX, value: state.cuts[state.held].value,
        each: value(event.offsetX + 1) - value(event.offsetX),
        times: value(event.offsetX + 1) / value(event.offsetX) };
    });
    canvas.on("mousemove", (event) => {
      if (state.held === null) {
        canvas.setCursorStyle(nearest(event.offsetX) === null ? "default" : "ew-resize");
        return;
      }
      canvas.setCursorStyle("ew-resize");
      const moved = event.offsetX - state.from.x;
      state.cuts[state.held].value = chart.getOption().xAxis[0].type === "log"
        ? state.from.value * state.from.times ** moved
        : state.from.value + moved * state.from.each;
      draw();
      const now = performance.now();
      if (now - state.told > 40) { state.told = now; tell(false); }
    });
    const drop = () => {
      if (state.held === null) return;
      tell(true);
      state.held = null;
    };
    canvas.on("mouseup", drop);
    canvas.on("globalout", drop);
  };

  return { start, togglePanels, address, threshold, pieces: () => pieces, drop: () => socket.close() };
})();
