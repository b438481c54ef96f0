// Ask a map where frames were taken: files that are dropped or chosen, or what the webcam sees.
import { get, key, ROOT, send } from "../shared/api.js";
import { Answer } from "../shared/answer.js";
import { Copy, Field, Head, Loading, Trouble, Verdict } from "../shared/elements.js";
import { integer, milliseconds, percent } from "../shared/formats.js";
import { handedOver, readable } from "../shared/frames.js";
import { mapPath } from "../shared/map_path.js";
import { useResource } from "../shared/resource.js";
import { html, useEffect, useRef, useState } from "../shared/view.js";

const MOST = 100;

export default function Try({ map }) {
  const [options, setOptions] = useState({ k: 5, verify: "auto", camera: "", sequences: "", given: {} });
  const [asked, setAsked] = useState([]);
  const [shown, setShown] = useState(null);
  const number = useRef(0);
  const urls = useRef(new Map());
  const present = useRef(options);
  present.current = options;
  const forget = (kept) => {
    for (const [id, url] of urls.current) {
      if (kept.has(id)) continue;
      URL.revokeObjectURL(url);
      urls.current.delete(id);
    }
  };
  useEffect(() => forget(new Set(asked.map((one) => one.id))), [asked]);
  useEffect(() => () => forget(new Set()), []);
  useEffect(() => {
    if (handedOver.value) {
      const { file, question } = handedOver.value;
      const { k = 5, verify = "auto", camera = "", ...others } = question;
      present.current = { k, verify, camera, sequences: "", given: others };
      setOptions(present.current);
      ask([file]);
      handedOver.value = null;
    }
  }, []);

  const change = (id, changes) => setAsked((old) => old.map((one) => (one.id === id ? { ...one, ...changes } : one)));
  const ask = async (files) => {
    const added = files.slice(0, MOST).map((file) => ({ id: (number.current += 1), file, name: file.name || "frame", state: "waiting" }));
    setAsked((old) => [...added, ...old].slice(0, MOST));
    setShown(added[0]?.id ?? null);
    const asking = present.current; // as it was chosen when they were handed in
    for (const one of added) {
      try {
        const frame = await readable(one.file);
        urls.current.set(one.id, frame.url);
        change(one.id, { frame, state: "asking" });
        const answer = await query(map, frame, asking);
        change(one.id, { answer, state: "answered" });
      } catch (error) {
        change(one.id, { error, state: "failed" });
      }
    }
  };
  const current = asked.find((one) => one.id === shown) || null;
  return html`
    <${Head} title="Try" note=${`Where was a frame taken? Ask ${map}.`} />
    <div class="columns try">
      <section class="panel" aria-label="Frames"><${Source} ask=${ask} /></section>
      <section class="panel" aria-label="Options">
        <${Again} given=${options.given} drop=${() => setOptions({ ...options, given: {} })} />
        <${Options} map=${map} options=${options} change=${(changes) => setOptions({ ...options, ...changes })} />
        <${AsCode} map=${map} options=${options} frame=${current?.frame} name=${current?.name} />
      </section>
    </div>
    ${asked.length > 1 && html`<${Asked} items=${asked} shown=${shown} show=${setShown} clear=${() => setAsked([])} />`}
    ${current?.error && html`<${Trouble} error=${current.error} />`}
    ${current && !current.error && !current.answer && html`<${Loading} what="Asking" />`}
    ${current?.answer && html`<${Answer} key=${current.id} map=${map} answer=${current.answer} frame=${current.frame} />`}
  `;
}

async function query(map, frame, options) {
  const parameters = given(options);
  const headers = { "Content-Type": frame.type };
  return (await send("POST", mapPath(map, "query"), { query: parameters, body: frame.blob, headers })).json();
}

function Source({ ask }) {
  const [over, setOver] = useState(false);
  const [webcam, setWebcam] = useState(false);
  const input = useRef(null);
  const latest = useRef(ask);
  latest.current = ask;
  useEffect(() => {
    const controller = new AbortController();
    const on = (kind, call) => addEventListener(kind, call, { signal: controller.signal });
    on("dragover", (event) => event.dataTransfer?.types.includes("Files") && setOver(true));
    on("dragleave", (event) => event.relatedTarget === null && setOver(false));
    on("drop", (event) => {
      setOver(false);
      const files = [...(event.dataTransfer?.files || [])];
      if (files.length > 0 && !event.target.closest?.("input")) latest.current(files);
    });
    return () => controller.abort();
  }, []);
  if (webcam) return html`<${Webcam} ask=${ask} close=${() => setWebcam(false)} />`;
  return html`
    <div class=${over ? "drop over" : "drop"}>
      <p><strong>Drop pictures here</strong> <span class="faint">or beside</span></p>
      <div class="row">
        <button type="button" class="primary" onClick=${() => input.current.click()}>Choose pictures</button>
        <button type="button" onClick=${() => setWebcam(true)}>Use the webcam</button>
      </div>
      <input ref=${input} class="hidden" type="file" multiple accept="image/*" aria-label="Pictures" tabindex="-1" onChange=${(event) => { ask([...event.target.files]); event.target.value = ""; }} />
      <p class="faint small">JPEG, PNG and WebP are sent as they are; other kinds as PNG.</p>
    </div>
  `;
}

function Webcam({ ask, close }) {
  const video = useRef(null);
  const [error, setError] = useState(null);
  const [ready, setReady] = useState(false);
  const [repeated, setRepeated] = useState(false);
  useEffect(() => {
    let stream = null;
    let gone = false;
    const begin = async () => {
      if (!navigator.mediaDevices) throw new Error("The browser gives a camera only to pages of this machine or over https.");
      stream = await navigator.mediaDevices.getUserMedia({ video: { facingMode: "environment", width: { ideal: 1280 } } });
      if (gone) return stop();
      video.current.srcObject = stream;
      return undefined;
    };
    const stop = () => stream?.getTracks().forEach((track) => track.stop());
    begin().catch((problem) => setError(Object.assign(problem, { title: "No camera" })));
    return () => {
      gone = true;
      stop();
    };
  }, []);
  const take = async () => {
    const { videoWidth: width, videoHeight: height } = video.current;
    if (!width) return;
    const canvas = new OffscreenCanvas(width, height);
    canvas.getContext("2d").drawImage(video.current, 0, 0);
    const blob = await canvas.convertToBlob({ type: "image/jpeg", quality: 0.92 });
    await ask([new File([blob], `webcam ${new Date().toLocaleTimeString("en-GB")}.jpg`, { type: "image/jpeg" })]);
  };
  useEffect(() => {
    if (!repeated) return undefined;
    let going = true;
    const loop = async () => {
      while (going) {
        await take();
        await new Promise((resolve) => setTimeout(resolve, 1000));
      }
    };
    loop();
    return () => {
      going = false;
    };
  }, [repeated]);
  if (error) return html`<${Trouble} error=${error} close=${close} />`;
  return html`
    <video ref=${video} onLoadedData=${() => setReady(true)} autoplay muted playsinline aria-label="Picture of the webcam"></video>
    <div class="row">
      <button type="button" class="primary" disabled=${!ready} onClick=${take}>Ask with this frame</button>
      <label class="row"><input type="checkbox" checked=${repeated} onChange=${() => setRepeated(!repeated)} /> every second</label>
      <button type="button" onClick=${close}>Stop</button>
    </div>
  `;
}

/** The filters of a question that is asked again; they hold until they are dropped. */
function Again({ given: others, drop }) {
  const names = Object.keys(others);
  if (names.length === 0) return null;
  return html`
    <div class="notice spread" role="group" aria-label="Filters of the question">
      <span>As it was asked: ${names.map((name, one) => html`${one > 0 && ", "}<code>${name} = ${String(others[name])}</code>`)}</span>
      <button type="button" class="small" onClick=${drop}>Drop them</button>
    </div>
  `;
}

function Options({ map, options, change }) {
  const cameras = useResource((signal) => get(mapPath(map, "cameras"), {}, { signal }), [map]);
  const sequences = useResource((signal) => get(mapPath(map, "sequences"), { limit: 1000 }, { signal }), [map]);
  const names = (resource) => (resource.data?.items || []).map((one) => html`<option value=${one.name}>${one.name}</option>`);
  return html`
    <div class="fields narrow">
      <${Field} label="Matches"><input type="number" min="1" max="100" value=${options.k} onInput=${(event) => change({ k: event.target.value || 5 })} /><//>
      <${Field} label="Verify">
        <select value=${options.verify} onChange=${(event) => change({ verify: event.target.value })}>
          <option value="auto">where in doubt</option><option value="always">always</option><option value="never">never</option>
        </select>
      <//>
      <${Field} label="Camera">
        <select value=${options.camera} onChange=${(event) => change({ camera: event.target.value })}><option value="">none named</option>${names(cameras)}</select>
      <//>
      <${Field} label="Among">
        <select value=${options.sequences} onChange=${(event) => change({ sequences: event.target.value })}><option value="">all traverses</option>${names(sequences)}</select>
      <//>
    </div>
  `;
}

/** The same request for a shell and for Python. */
function AsCode({ map, options, frame, name = "frame.jpg" }) {
  const [language, setLanguage] = useState("curl");
  const text = language === "curl" ? curl(map, options, frame, name) : python(map, options, name);
  return html`
    <div class="spread">
      <div class="segments" role="group" aria-label="The same request as">
        <button type="button" aria-pressed=${language === "curl"} onClick=${() => setLanguage("curl")}>curl</button>
        <button type="button" aria-pressed=${language === "python"} onClick=${() => setLanguage("python")}>Python</button>
      </div>
      <${Copy} text=${text} />
    </div>
    <pre tabindex="0" aria-label="The same request">${text}</pre>
  `;
}

function quoted(text) {
  return `'${text.replaceAll("'", "'\\''")}'`;
}

/** The parameters of a query: those of another one that is asked again, and what was chosen here. */
function given({ k, verify, camera, sequences, given: others }) {
  const parameters = { ...Object.fromEntries(Object.entries(others).map(([name, value]) => [name, String(value)])), k: String(k), explain: "true" };
  if (verify !== "auto") parameters.verify = verify;
  if (camera) parameters.camera = camera;
  if (sequences) parameters.sequences = JSON.stringify([sequences]);
  return parameters;
}

function curl(map, options, frame, name) {
  const url = new URL(`v1${mapPath(map, "query")}`, ROOT);
  url.search = new URLSearchParams(given(options));
  const lines = [`curl ${quoted(url.href)}`, `-H 'Content-Type: ${frame?.type || "image/jpeg"}'`];
  if (key.value) lines.push('-H "Authorization: Bearer $PLACEREC_KEY"');
  lines.push(`--data-binary ${quoted(`@${name}`)}`);
  return lines.join(" \\\n  ");
}

function python(map, options, name) {
  const { explain, k, sequences, ...others } = given(options);
  const literal = (value) => (/^-?\d+(\.\d+)?$/.test(value) ? value : JSON.stringify(value));
  const named = [`k=${k}`, "explain=True", ...Object.entries(others).map(([one, value]) => `${one}=${literal(value)}`)];
  if (sequences) named.push(`sequences=${sequences.startsWith("[") ? sequences : JSON.stringify(sequences.split(","))}`);
  const credentials = key.value ? ', key=os.environ["PLACEREC_KEY"]' : "";
  return [
    ...(key.value ? ["import os", ""] : []),
    "from placerec_client import Client",
    "",
    `with Client(${JSON.stringify(ROOT.href.replace(/\/$/, ""))}${credentials}) as client:`,
    `    answer = client.maps[${JSON.stringify(map)}].query(${JSON.stringify(name)}, ${named.join(", ")})`,
    "    print(answer.verdict, answer.probability)",
  ].join("\n");
}

function Asked({ items, shown, show, clear }) {
  return html`
    <section class="panel" aria-label="Queries so far">
      <div class="spread"><h2>${integer(items.length)} frames</h2><button type="button" class="small" onClick=${clear}>Clear</button></div>
      <div class="table limited" tabindex="0" role="region" aria-label="Frames">
        <table>
          <thead><tr><th>Frame</th><th>Verdict</th><th class="number">Probability</th><th>Place</th><th class="number">Took</th></tr></thead>
          <tbody>
            ${items.map((one) => html`
              <tr key=${one.id} aria-selected=${one.id === shown ? "true" : undefined}>
                <td class="long"><button type="button" class="link" onClick=${() => show(one.id)}>${one.name}</button></td>
                <td>${one.answer ? html`<${Verdict} verdict=${one.answer.verdict} />` : one.error ? html`<span class="pill bad">${one.error.title || "failed"}</span>` : html`<span class="faint">${one.state}</span>`}</td>
                <td class="number">${percent(one.answer?.probability)}</td>
                <td>${one.answer?.place?.id || "–"}</td>
                <td class="number">${milliseconds(one.answer?.milliseconds.total)}</td>
              </tr>
            `)}
          </tbody>
        </table>
      </div>
    </section>
  `;
}
