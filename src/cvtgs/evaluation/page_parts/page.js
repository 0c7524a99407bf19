"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const state = { view: 1, small: 1, split: 50, error: 0 };
  const root = document.documentElement;
  const at = (id) => document.getElementById(id);
  const stage = at("stage");

  const number = (value, digits, signDisplay = "auto") => value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits, signDisplay });
  const count = (value) => number(value, 0);
  const decibels = (value) => (Number.isFinite(Number(value)) ? number(Number(value), 2) + " dB" : "equal");
  const meanDecibels = ({ mean, views }) => {
    const counted = views.map(Number).filter((value, view) => !data.blind.includes(view));
    const finite = counted.filter(Number.isFinite);
    if (Number.isFinite(Number(mean)) || !finite.length) return decibels(mean);
    const others = finite.reduce((sum, value) => sum + value, 0) / finite.length;
    return `${decibels(others)}, ${counted.length - finite.length} equal`;
  };
  const bytes = (value) => {
    if (value === null) return "";
    let unit = "B";
    for (const larger of ["kB", "MB", "GB"]) {
      if (value < 999.5) break; // else 1,000
      value /= 1000;
      unit = larger;
    }
    return number(value, unit === "B" || value >= 99.95 ? 0 : 1) + " " + unit;
  };
  const difference = (scene) => {
    const ratio = data.reference.count / Math.max(1, scene.count);
    if (Math.abs(ratio - 1) < 0.005) return "As many";
    const [factor, word] = ratio > 1 ? [ratio, "fewer"] : [1 / ratio, "more"];
    const digits = factor >= 9.95 || Number.isInteger(factor) ? 0 : factor < 1.1 ? 2 : 1;
    return `${number(factor, digits)}× ${word}`;
  };
  const join = (...parts) => parts.filter(Boolean).join(" · ");
  const gaussians = (scene) => `${count(scene.count)} Gaussian${scene.count === 1 ? "" : "s"}`;
  const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

  const make = (tag, text, attributes = {}) => {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    return element;
  };

  const metrics = [
    ["PSNR", (scene) => scene.psnr, decibels, meanDecibels],
    ["SSIM", (scene) => scene.ssim, (value) => number(Number(value), 3)],
    ["LPIPS", (scene) => scene.lpips, (value) => number(Number(value), 3)],
    ["Alpha error", (scene) => scene.alpha_error, (value) => number(Number(value), 4)],
    ["Alpha bias", (scene) => scene.alpha_bias, (value) => number(Number(value), 4, "exceptZero")],
  ].filter(([, of]) => data.small.every((scene) => of(scene)));

  const maps = [
    { key: "images", tag: (scene) => `${data.named ? scene.name : "Simplified"} · ${count(scene.count)}`, alt: (scene, name) => `${name} of ${scene.name}, ${gaussians(scene)}` },
    { key: "errors", tag: () => "Colour error", alt: (scene, name) => `Where colours of ${scene.name} differ from the full scene in ${name}` },
    { key: "alpha_errors", tag: () => "Alpha error", alt: (scene, name) => `Where ${scene.name} covers less or more than the full scene in ${name}` },
  ];

  const table = (id, headings, rows) => {
    const head = make("thead");
    const top = head.appendChild(make("tr"));
    const kind = (column) => (column && column <= headings.length - metrics.length - 1 ? { class: "more" } : {});
    headings.forEach((heading, column) => top.append(make("th", heading, { scope: "col", ...kind(column) })));
    const body = make("tbody");
    for (const { cells, chosen } of rows) {
      const row = body.appendChild(make("tr"));
      row.classList.toggle("chosen", chosen);
      cells.forEach((cell, column) => row.append(column ? make("td", cell, kind(column)) : make("th", cell, { scope: "row" })));
    }
    at(id).replaceChildren(head, body);
  };

  const choice = (group, value, content) => {
    const label = make("label");
    const input = make("input", undefined, { type: "radio", name: group, value: String(value) });
    input.addEventListener("change", () => change({ [group]: value }));
    label.append(input, ...content);
    return label;
  };

  const build = () => {
    const { reference, small, views } = data;
    root.style.setProperty("--ratio", data.width / data.height);
    root.style.setProperty("--columns", clamp(views.length, 1, 8));
    at("title").textContent = reference.name;
    at("lead").textContent =
      join(gaussians(reference), bytes(reference.bytes)) +
      `, next to ${small.length === 1 ? "a simplified version" : small.length + " simplified versions"}` +
      ` from ${views.length === 1 ? "one view" : views.length + " views"}. Drag the divider: full on the left, simplified on the right.`;
    at("scenes").append(...small.map((scene, index) => choice("small", index + 1, [
      make("b", data.named ? scene.name : difference(scene)),
      make("span", meanDecibels(scene.psnr), { class: "psnr" }),
      make("small", join(gaussians(scene), bytes(scene.bytes), data.named ? "" : scene.name)),
    ])));
    at("views").append(...views.map((name, index) => choice("view", index + 1, [
      make("img", undefined, { src: data.full[index], alt: name, title: name, loading: "lazy" }),
    ])));
    const lpips = data.lpips ? `, LPIPS (${data.lpips === "vgg" ? "VGG" : "Alex"}) is lower for closer images` : "";
    at("about").textContent =
      `Scores compare images of each simplified scene with images of the full one, ${data.width} × ${data.height} pixels: ` +
      `higher PSNR and SSIM mean closer${lpips}. ` +
      "Alpha is the share of a pixel that a scene covers; its error is a mean of absolute differences, and its bias is below zero where more of the background shows through. " +
      `${data.scored > views.length ? `Means are over ${data.scored} views, of which ${views.length} are shown. ` : ""}Rendered by cvtgs with its ${data.backend} backend.`;
  };

  const show = () => {
    const scene = data.small[state.small - 1];
    const name = data.views[state.view - 1];
    const index = state.view - 1;
    at("full").src = data.full[index];
    at("full").alt = `${name} of ${data.reference.name}, ${gaussians(data.reference)}`;
    const map = maps[state.error];
    at("small").src = scene[map.key][index];
    at("small").alt = map.alt(scene, name);
    at("tag-full").textContent = `Full · ${count(data.reference.count)}`;
    at("tag-small").textContent = map.tag(scene);
    at("view-name").textContent = name;
    at("score").textContent = join(...metrics.map(([label, of, text]) => `${label} ${text(of(scene).views[data.shown[index]])}`));
    at("differences").setAttribute("aria-pressed", String(state.error === 1));
    at("alpha").setAttribute("aria-pressed", String(state.error === 2));
    at("scale").hidden = state.error !== 1;
    at("alpha-scale").hidden = state.error !== 2;
    for (const group of ["small", "view"]) {
      document.querySelectorAll(`input[name=${group}]`).forEach((input) => { input.checked = Number(input.value) === state[group]; });
    }
    const labels = metrics.map(([label]) => label);
    const sized = data.small.some((one) => one.bytes !== null);
    table("means", ["Scene", "Gaussians", ...(sized ? ["Size"] : []), ...labels], data.small.map((one, row) => ({
      chosen: row === state.small - 1,
      cells: [one.name, count(one.count), ...(sized ? [bytes(one.bytes)] : []), ...metrics.map(([, of, text, mean]) => (mean ? mean(of(one)) : text(of(one).mean)))],
    })));
    at("views-title").textContent = `Per view of ${scene.name}`;
    table("per-view", ["View", ...labels], data.views.map((view, row) => ({
      chosen: row === index,
      cells: [view, ...metrics.map(([, of, text]) => text(of(scene).views[data.shown[row]]))],
    })));
    slide();
  };

  const slide = () => {
    root.style.setProperty("--split", state.split);
    const input = at("split");
    input.value = state.split;
    input.setAttribute("aria-valuetext", `${state.split} % full scene`);
    at("tag-full").classList.toggle("away", state.split < 24);
    at("tag-small").classList.toggle("away", state.split > 76);
    for (const key of Object.keys(state)) root.dataset[key] = state[key];
  };

  let waiting = 0;
  const remember = () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => {
      const { view, small, split, error } = state;
      const hash = `#view=${view}&small=${small}&split=${split}${error ? "&error=" + error : ""}`;
      try { history.replaceState(null, "", hash); } catch { /* not allowed everywhere, and not needed */ }
    }, 150);
  };

  const change = (changes) => {
    const only = Object.keys(changes).join() === "split";
    Object.assign(state, changes);
    only ? slide() : show();
    remember();
  };

  const restore = () => {
    const words = new URLSearchParams(location.hash.slice(1));
    const read = (key, low, high) => {
      const value = parseInt(words.get(key), 10);
      if (Number.isFinite(value)) state[key] = clamp(value, low, high);
    };
    read("view", 1, data.views.length);
    read("small", 1, data.small.length);
    read("split", 0, 100);
    read("error", 0, 2);
    show();
  };

  const step = (by) => change({ view: ((state.view - 1 + by + data.views.length) % data.views.length) + 1 });
  const toggle = (error) => change({ error: state.error === error ? 0 : error });

  const drag = (event) => {
    const box = stage.getBoundingClientRect();
    change({ split: Math.round(clamp((100 * (event.clientX - box.left)) / box.width, 0, 100)) });
  };
  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    stage.setPointerCapture(event.pointerId);
    at("split").focus({ preventScroll: true, focusVisible: false });
    drag(event);
    event.preventDefault();
  });
  stage.addEventListener("pointermove", (event) => { if (stage.hasPointerCapture(event.pointerId)) drag(event); });
  at("split").addEventListener("input", () => change({ split: Number(at("split").value) }));
  at("previous").addEventListener("click", () => step(-1));
  at("next").addEventListener("click", () => step(1));
  at("differences").addEventListener("click", () => toggle(1));
  at("alpha").addEventListener("click", () => toggle(2));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const typing = event.target.closest?.("input, .scroller") != null;
    const key = event.key.toLowerCase();
    if (key === "n") step(1);
    else if (key === "p") step(-1);
    else if (key === "d") toggle(1);
    else if (key === "a") toggle(2);
    else if (/^[1-9]$/.test(key) && Number(key) <= data.small.length) change({ small: Number(key) });
    else if (!typing && key === "arrowleft") change({ split: clamp(state.split - 2, 0, 100) });
    else if (!typing && key === "arrowright") change({ split: clamp(state.split + 2, 0, 100) });
  });
  window.addEventListener("hashchange", restore);

  const measure = () => { root.dataset.layout = `${root.scrollWidth}/${window.innerWidth}`; };
  window.addEventListener("resize", measure);
  build();
  restore();
  measure();
  window.addEventListener("load", measure);
  root.dataset.ready = "yes";
})();
