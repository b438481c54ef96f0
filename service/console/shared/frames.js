// Frames on their way to the service: what it takes as it is, and what has to become a PNG first.
import { signal } from "./view.js";

const TAKEN = ["image/jpeg", "image/png", "image/webp"];

/** A frame that another view hands over to be tried: {file, question}, the parameters with which it was asked. */
export const handedOver = signal(null);

/** A file as a frame: {blob, type, url, ratio}.
 *
 * Throws if the browser cannot show it.
 */
export async function readable(file) {
  let picture;
  try {
    picture = await createImageBitmap(file, { imageOrientation: "from-image" });
  } catch {
    throw Object.assign(new Error(`${file.name || "The file"} is not a picture that the browser can read.`), { title: "Not a picture" });
  }
  const blob = TAKEN.includes(file.type) ? file : await asPng(picture);
  return { blob, type: blob.type, url: URL.createObjectURL(blob), ratio: picture.width / picture.height };
}

async function asPng(picture) {
  const canvas = new OffscreenCanvas(picture.width, picture.height);
  canvas.getContext("2d").drawImage(picture, 0, 0);
  return canvas.convertToBlob({ type: "image/png" });
}

/** The blob of a data: URL, which the page's policy does not let it fetch. */
export function blobOf(url) {
  const [, type, text] = /^data:([a-z/]+);base64,(.*)$/.exec(url);
  return new Blob([Uint8Array.from(atob(text), (one) => one.charCodeAt(0))], { type });
}
