// Code in text and tables breaks at spaces only: browsers also break after each "-" of a flag such as --config.seed.
const LONGEST = 40; // letters of a word that fits on a phone
for (const code of document.querySelectorAll(".md-typeset :not(pre) > code")) {
  if (code.children.length) continue; // it has links
  const words = code.textContent.split(" ").map((word) => {
    if (word.length > LONGEST) return word;
    const span = document.createElement("span");
    span.style.whiteSpace = "nowrap";
    span.textContent = word;
    return span;
  });
  code.replaceChildren(...words.flatMap((word, i) => (i ? [" ", word] : [word])));
}
