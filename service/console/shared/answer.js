// The answer to one frame: the verdict, the matches beside the frame, why the best one matches, and what took how long.
import { Facts, Name, Verdict } from "./elements.js";
import { changeText, decimal, encoderName, integer, metres, milliseconds, percent, poseText } from "./formats.js";
import { Picture, Thumbnail, thumbnailPath } from "./pictures.js";
import { readPlan } from "./plan_data.js";
import { useResource } from "./resource.js";
import { href } from "./router.js";
import { SmallPlan } from "./small_plan.js";
import { html, useMemo, useState } from "./view.js";

const REASONS = {
  "no-regions": "The frame shows nothing to compare, as a blank wall does.",
  "few-values": "The frame has 16 bits and uses so few of their values that it shows nothing: give its camera in the map a range of values.",
  "empty-map": "The map has no places.",
  "no-place-allowed": "No place fits the filters.",
};

/** frame: {url, ratio} of the picture that was sent. */
export function Answer({ map, answer, frame }) {
  const [rank, setRank] = useState(1);
  const match = answer.matches.find((one) => one.rank === rank) || answer.matches[0] || null;
  return html`
    <div class="answer">
      <section class="panel" aria-label="Answer">
        <${Summary} map=${map} answer=${answer} />
        ${match && html`<${Pair} map=${map} frame=${frame} match=${match} why=${match.rank === 1 ? answer.explanation : null} few=${answer.verdict === "unknown"} />`}
        ${!match && html`<div class="pair alone"><img src=${frame.url} alt="The frame" /></div>`}
      </section>
      ${answer.matches.length > 0 && html`<${Where} map=${map} answer=${answer} />`}
      ${answer.matches.length > 0 && html`
        <section class="panel" aria-label="Matches">
          <h2>Matches</h2>
          <ol class="matches">
            ${answer.matches.map((one) => html`<${MatchTile} key=${one.place.id} map=${map} match=${one} chosen=${one === match} among=${answer.matches.map(({ place }) => place.id)} choose=${setRank} />`)}
          </ol>
        </section>
      `}
      <div class="columns">
        <section class="panel"><h2>Why</h2><${Why} answer=${answer} /></section>
        <section class="panel"><h2>Time</h2><${Timings} milliseconds=${answer.milliseconds} /></section>
      </div>
    </div>
  `;
}

function Summary({ map, answer }) {
  const { verdict, probability, place, reason, rivals = [], pose, change } = answer;
  return html`
    <div class="spread">
      <p class="large"><${Verdict} verdict=${verdict} />${place && html` as <a href=${href("maps", map, "places", place.id)}>${place.id}</a>`}</p>
      <p class="large">${probability !== null && probability !== undefined && html`${percent(probability, 1)} <span class="faint small">probable</span>`}</p>
    </div>
    ${answer.matches.length > 0 && html`<p class="sentence">${sentenceOf(answer)}</p>`}
    ${reason && html`<p>${REASONS[reason] || reason}</p>`}
    ${rivals.length > 0 && html`
      <p>
        Rivals: ${rivals.map((rival, one) => html`${one > 0 && "; "}${rival.places.slice(0, 3).map((id, two) => html`${two > 0 && ", "}<a href=${href("maps", map, "places", id)}>${id}</a>`)}
        <span class="faint"> ${rival.same_place ? "the same place" : "another place"}, ${decimal(rival.score)}</span>`)}
      </p>
    `}
    ${change && html`<p class="faint">The view is ${changeText(change)}</p>`}
    ${pose && html`<p class="faint">Pose ${poseText(pose)} ± ${metres(pose.spread)}</p>`}
  `;
}

/** Why the verdict is what it is, in one sentence. */
export function sentenceOf({ verdict, decision, threshold, margin, probability, matches }) {
  const inliers = matches[0]?.parts?.inliers ?? null;
  const parts = [];
  const above = decision !== null && decision >= threshold;
  if (decision !== null) {
    const digits = [3, 4, 5, 6].find((one) => decision.toFixed(one) !== threshold.toFixed(one)) || 6;
    parts.push(`${decimal(decision, digits)} is ${decision === threshold ? "at" : above ? "above" : "below"} ${decimal(threshold, digits)}`);
  }
  if (margin === null) parts.push("no other place comes into question");
  else parts.push(margin < 0 ? `another place is ${decimal(-margin)} ahead` : `the next place is ${decimal(margin)} behind`);
  if (inliers !== null) {
    parts.push(`geometry agrees on ${inliers === 1 ? "one point" : `${integer(inliers)} points`}`);
    // A match that was verified stands out by its probability, whatever its decision value is.
    if ((verdict === "recognized") !== above && verdict !== "ambiguous") parts.push(`which makes it ${percent(probability)} probable`);
  }
  const text = parts.join("; ").replace("; which", ", which");
  return `${text[0].toUpperCase()}${text.slice(1)}.`;
}

/** The place on the plan, with the other matches ringed. */
function Where({ map, answer }) {
  const plan = useResource((signal) => readPlan(map, signal), [map]);
  const marks = useMemo(() => (plan.data ? whereMarks(plan.data, answer) : {}), [plan.data, answer]);
  if (!plan.data || plan.data.count === 0) return null;
  if (!plan.data.index.has(answer.matches[0].place.id)) return null;
  const text = answer.verdict === "recognized" ? "The place" : "The best match";
  return html`
    <section class="panel" aria-label="On the plan">
      <div class="spread"><h2>On the plan</h2><a href=${href("maps", map, "plan", { place: answer.matches[0].place.id })}>Open the plan</a></div>
      <${SmallPlan} plan=${plan.data} marks=${marks} label=${`${text}, ${answer.matches[0].place.id}, on the plan of ${map}.`} />
      <p class="faint small">${text} is ringed in blue, other matches in amber${marks.robots?.length ? "; the arrow is the pose that was estimated" : ""}.</p>
    </section>
  `;
}

function whereMarks(plan, { matches, pose, verdict }) {
  const numbers = matches.map((one) => plan.index.get(one.place.id)).filter((one) => one !== undefined);
  const point = pose ? plan.projection?.(pose) : null;
  const robots = point ? [{ x: point.x, y: point.y, angle: point.heading, trail: [], label: "", verdict }] : [];
  return { chosen: numbers[0] ?? null, misleading: numbers.slice(1), robots };
}

const FEW = 15;
const LAYERS = [
  ["inliers", "Inliers", (why) => why.inliers.length],
  ["cells", "Cells", (why) => why.cells.length],
  ["regions", "Regions", (why) => why.regions.length],
];

/** The frame beside a match; with an explanation, what connects them is drawn over both.
 *
 * few: only the strongest lines are drawn at first: of what was not recognized, most connect nothing.
 */
function Pair({ map, frame, match, why, few }) {
  const kinds = why ? LAYERS.filter(([, , count]) => count(why) > 0) : [];
  const [kind, setKind] = useState(null);
  const [strongest, setStrongest] = useState(few);
  const usual = (few && kinds.find(([id]) => id === "cells")) || kinds[0];
  const shown = kinds.some(([id]) => id === kind) || kind === "" ? kind : usual?.[0];
  const many = why && shown === "cells" && why.cells.length > FEW;
  return html`
    ${kinds.length > 0 && html`
      <div class="row">
        <div class="segments" role="group" aria-label="Drawn over the frames">
          ${kinds.map(([id, name, count]) => html`<button type="button" aria-pressed=${shown === id} onClick=${() => setKind(id)}>${name} <span class="faint">${integer(count(why))}</span></button>`)}
          <button type="button" aria-pressed=${shown === ""} onClick=${() => setKind("")}>Nothing</button>
        </div>
        ${many && html`<label class="row"><input type="checkbox" checked=${strongest} onChange=${() => setStrongest(!strongest)} /> the ${FEW} strongest only</label>`}
      </div>
    `}
    <figure class="stack">
      <div class="pair" style=${{ "--ratio": frame.ratio || 4 / 3 }}>
        <img src=${frame.url} alt="The frame" />
        <${Picture} path=${thumbnailPath(map, match.place.id)} version=${match.place.updated_at} alt=${`Place ${match.place.id}`} />
        ${why && shown && html`<${Overlay} why=${why} kind=${shown} most=${strongest ? FEW : Infinity} />`}
      </div>
      <figcaption class="spread small faint"><span>the frame</span><span>${match.place.id}, rank ${match.rank}</span></figcaption>
    </figure>
  `;
}

/** Lines and boxes over both frames; each frame is one unit wide. */
function Overlay({ why, kind, most }) {
  return html`
    <svg viewBox="0 0 2 1" preserveAspectRatio="none" aria-hidden="true" class=${`overlay ${kind}`}>
      ${kind === "regions" ? why.regions.map((pair) => html`<${RegionPair} why=${why} pair=${pair} />`) : linesOf(why, kind, most).map(([x1, y1, x2, y2, strength, width]) => html`
        <line x1=${x1} y1=${y1} x2=${1 + x2} y2=${y2} opacity=${strength} style=${width ? { strokeWidth: `${width}px` } : undefined} vector-effect="non-scaling-stroke" />
      `)}
    </svg>
  `;
}

/** Lines as from and to, how opaque and how wide they are; of the cells the strongest `most`, by their gain. */
function linesOf(why, kind, most) {
  if (kind === "inliers") return why.inliers.map(({ query, match }) => [...query, ...match, Math.min(0.8, 0.2 + 40 / why.inliers.length)]);
  const [rows, columns] = why.grid;
  const cells = [...why.cells].sort((one, other) => other.gain - one.gain).slice(0, most);
  const greatest = Math.max(...cells.map((cell) => cell.gain), 1e-9);
  const centre = ([row, column]) => [(column + 0.5) / columns, (row + 0.5) / rows];
  return cells.map(({ query, match, gain }) => {
    const weight = Math.max(0, gain / greatest);
    return [...centre(query), ...centre(match), 0.15 + 0.8 * weight, most < Infinity ? 1 + 3 * weight : null];
  });
}

function RegionPair({ why, pair }) {
  const boxes = [[why.query_regions[pair.query].box, 0], [why.match_regions?.[pair.match].box, 1]];
  return boxes.map(([box, aside]) => box && html`
    <rect x=${box.left + aside} y=${box.top} width=${box.right - box.left} height=${box.bottom - box.top} vector-effect="non-scaling-stroke" />
  `);
}

function MatchTile({ map, match, chosen, among, choose }) {
  const { place, rank, score, parts } = match;
  return html`
    <li class=${chosen ? "thumb chosen" : "thumb"}>
      <button type="button" class="cover" aria-pressed=${chosen} aria-label=${`Show match ${rank}, ${place.id}`} onClick=${() => choose(rank)}>
        <${Thumbnail} map=${map} place=${place.id} version=${place.updated_at} />
      </button>
      <span class="under"><a class="name" href=${href("maps", map, "places", place.id)}><${Name} text=${place.id} among=${among} /></a><span>${decimal(score)}</span></span>
      ${parts && html`<span class="faint small">${partsOf(parts)}${parts.inliers !== null && `, ${parts.inliers} inliers`}</span>`}
      ${place.sequence && html`<span class="faint small clip"><${Name} text=${place.sequence} /></span>`}
    </li>
  `;
}

function partsOf({ similarity, agreement, geometry }) {
  return [similarity, agreement, geometry].filter((part) => part != null).map((part) => decimal(part)).join(" + ");
}

function Why({ answer }) {
  const { score, margin, decision, threshold, matches, explanation, verification, encoder } = answer;
  const parts = matches[0]?.parts;
  const checked = verification && (verification.state ?? verification.verified ?? null);
  return html`
    <${Facts} rows=${[
      ["Score", decimal(score)],
      parts && [parts.geometry == null ? "Similarity + agreement" : "Similarity + agreement + geometry", partsOf(parts)],
      ["Margin to the best rival", decimal(margin)],
      ["Decision value", html`${decimal(decision)} <span class="faint">threshold ${decimal(threshold)}</span>`],
      parts && parts.inliers !== null && ["Inliers", `${integer(parts.inliers)} of ${integer(parts.keypoints)}`],
      parts && parts.evidence !== null && parts.evidence !== undefined && ["Evidence", decimal(parts.evidence, 1)],
      checked !== null && checked !== undefined && ["Geometry", String(checked)],
      ["Encoder", encoderName(encoder), encoder],
    ]} />
    ${explanation && explanation.words.length > 0 && html`
      <h3>Contribution of each word</h3>
      <${Words} words=${explanation.words} />
    `}
  `;
}

function Words({ words }) {
  const most = Math.max(...words.map(Math.abs), 1e-9);
  const total = words.reduce((sum, one) => sum + Math.max(0, one), 0) || 1;
  const best = words.map((value, word) => [value, word]).sort((a, b) => b[0] - a[0]).slice(0, 5);
  const text = best.map(([value, word]) => `word ${word} ${percent(value / total)}`).join(", ");
  return html`
    <div class="words" role="img" aria-label=${`Shares of the words; the largest: ${text}`}>
      ${words.map((value, word) => html`<span class=${value < 0 ? "negative" : ""} title=${`word ${word}: ${decimal(value, 4)}`} style=${{ height: `${(100 * Math.abs(value)) / most}%` }}></span>`)}
    </div>
    <p class="faint small">The largest shares: ${text}.</p>
  `;
}

const LEAST_REST = 0.1;

/** Stages of the work as a bar and as a list, which add up to the total. */
export function Timings({ milliseconds: told }) {
  const named = Object.entries(told).filter(([name]) => name !== "total");
  const known = named.reduce((all, [, value]) => all + value, 0);
  const total = told.total ?? known;
  const rest = total - known;
  const stages = rest >= LEAST_REST ? [...named, ["other", rest]] : named;
  const sum = stages.reduce((all, [, value]) => all + value, 0) || 1;
  return html`
    <div class="stack">
      <div class="timings" aria-hidden="true">
        ${stages.map(([name, value], one) => html`<span class=${`tint-${one % 8}`} title=${`${name} ${milliseconds(value)}`} style=${{ flexGrow: value / sum }}></span>`)}
      </div>
      <ul class="stages">
        ${stages.map(([name, value], one) => html`<li><span class=${`swatch square tint-${one % 8}`}></span><span>${name}</span><span class="number">${milliseconds(value)}</span></li>`)}
        <li><span></span><strong>total</strong><strong class="number">${milliseconds(total)}</strong></li>
        ${rest <= -LEAST_REST && html`<li><span></span><span class="faint">some stages ran at the same time</span></li>`}
      </ul>
    </div>
  `;
}
