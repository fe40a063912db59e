// One value of the service that can be changed here. What was typed stays until the service has taken it.

let complaintCount = 0;

export class FormField {
  #options;
  #known = null;
  #edited = false;
  #complaint = null;

  /**
   * @param {object} options
   * @param {HTMLInputElement[]} options.controls what is used to change it
   * @param {HTMLElement} options.complaints where a complaint is shown
   * @param {string} options.label its name in a complaint
   * @param {() => unknown} options.read the value in the controls; undefined when it is none
   * @param {(value: unknown) => void} options.write puts a value into the controls
   * @param {(value: unknown) => void} options.changed a person has changed it
   * @param {() => void} options.reverted a person has taken the change back (Escape)
   */
  constructor(options) {
    this.#options = options;
    for (const control of options.controls) {
      control.addEventListener('input', () => this.#input());
      control.addEventListener('change', () => options.read() === undefined && this.complain('expected a number; Escape goes back'));
      control.addEventListener('keydown', ({ key }) => key === 'Escape' && this.#edited && this.#revert());
    }
  }

  /** What the service has now. */
  show(value) {
    this.#known = value;
    if (!this.#edited) this.#options.write(value);
  }

  /** The service has taken this value. It may have been changed again since. */
  accept(value) {
    if (JSON.stringify(this.#options.read()) !== JSON.stringify(value)) return;
    this.#edited = false;
    this.complain('');
  }

  /** Says next to the controls what is wrong; nothing when the text is empty. */
  complain(text) {
    const { controls, complaints, label } = this.#options;
    const said = text && `${label}: ${text}`;
    if (said === (this.#complaint?.textContent ?? '')) return;
    this.#complaint?.remove();
    this.#complaint = said ? document.createElement('p') : null;
    if (said) {
      this.#complaint.id = `complaint-${complaintCount += 1}`;
      this.#complaint.textContent = said;
      complaints.append(this.#complaint);
    }
    for (const control of controls) {
      control.ariaInvalid = said ? 'true' : null;
      if (said) control.setAttribute('aria-describedby', this.#complaint.id);
      else control.removeAttribute('aria-describedby');
    }
  }

  #input() {
    this.#edited = true;
    const value = this.#options.read();
    if (value !== undefined) this.#options.changed(value);
  }

  #revert() {
    this.#edited = false;
    this.complain('');
    this.#options.reverted();
    this.#options.write(this.#known);
  }
}

/** read and write of an `<input type="number">`. */
export function numberInput(input) {
  return {
    read: () => (input.value === '' ? undefined : Number(input.value)),
    write: (value) => {
      if (input.value === '' || Number(input.value) !== value) input.value = value;   // leaves “1.0” to whom types 1.05
    },
  };
}
